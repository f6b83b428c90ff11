// The files as Spark's meshes: RAD trees paged, chunk by chunk, everything else whole.
import { SplatMesh } from '@sparkjsdev/spark';
import { size, whole } from './text.js';

/** Whether the host of a file sends ranges of it; without them, Spark would fetch the whole file for each chunk. */
async function hasRanges(url) {
  const stop = new AbortController();
  const response = await fetch(url, { headers: { Range: 'bytes=0-0' }, signal: stop.signal }).catch(() => null);
  const partial = response?.status === 206;
  stop.abort();
  return partial;
}

export class ShownFile {
  /**
   * @param file as view.json has it.
   * @param modifier of Spark, for its splats.
   * @param changed is called when its state changes.
   * @param failed is called with what went wrong.
   */
  constructor(file, modifier, changed, failed) {
    Object.assign(this, { file, modifier, changed, failed, visible: true, builds: false, mesh: null, state: '', bad: false });
    this.isTree = file.leaves !== null;
  }

  get paged() {
    return Boolean(this.mesh?.paged);
  }

  /** Loads the file into a group; again, if it is there already. */
  async load(group) {
    this.unload(group);
    const { file } = this;
    const url = new URL(file.url, document.baseURI).href;
    const pages = file.paged && (file.chunked || (await hasRanges(url)));
    const progress = (event) => {
      if (event.total) this.say(`${whole((100 * event.loaded) / event.total)} % of ${size(file.bytes)}`);
    };
    const atOnce = { fileType: file.type, extSplats: true, onProgress: progress, lod: this.builds || undefined };
    this.say('loading');
    const mesh = new SplatMesh({ url, objectModifier: this.modifier, ...(pages ? { paged: true, fileType: 'rad' } : atOnce) });
    this.mesh = mesh;
    mesh.visible = this.visible;
    group.add(mesh);
    try {
      if (pages) this.watch(mesh.paged);
      await (pages ? mesh.paged.getRadMeta() : mesh.initialized);
      if (this.mesh === mesh) this.say(this.described(pages));
    } catch (error) {
      if (this.mesh === mesh) this.fail(error);
    }
  }

  described(pages) {
    const { file } = this;
    const tree = this.isTree ? `tree of ${whole(file.splats)} nodes` : `${whole(file.splats)} splats`;
    const how = pages ? `, ${whole(file.chunks)} chunks` : file.paged ? ', loaded whole: this host sends no ranges' : '';
    return `${file.format}, ${size(file.bytes)}, ${tree}${this.builds ? ', tree built here' : ''}${how}`;
  }

  /** Reports chunks that cannot be fetched, which Spark only writes to the console. */
  watch(paged) {
    const fetchChunk = paged.fetchDecodeChunk.bind(paged);
    paged.fetchDecodeChunk = (chunk) =>
      fetchChunk(chunk).catch((error) => {
        if (error.name !== 'AbortError') this.fail(error);
        throw error;
      });
  }

  show(visible) {
    this.visible = visible;
    if (this.mesh) this.mesh.visible = visible;
  }

  unload(group) {
    if (!this.mesh) return;
    group.remove(this.mesh);
    this.mesh.dispose();
    this.mesh = null;
  }

  say(state, bad = false) {
    this.state = state;
    this.bad = bad;
    this.changed(this);
  }

  fail(error) {
    const text = String(error?.message ?? error);
    this.say(`cannot be shown: ${text}`, true);
    this.failed(`${this.file.name} cannot be shown: ${text}`);
  }
}
