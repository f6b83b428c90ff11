// The files as Spark's meshes: RAD trees paged, chunk by chunk, everything else whole.
import { SplatMesh } from '@sparkjsdev/spark';
import { FileState } from './file_state.js';
import { size, whole } from './text.js';

/** Whether the host of a file sends ranges of it; without them, Spark would fetch the whole file for each chunk. */
async function hasRanges(url) {
  const stop = new AbortController();
  const response = await fetch(url, { headers: { Range: 'bytes=0-0' }, signal: stop.signal }).catch(() => null);
  const partial = response?.status === 206;
  stop.abort();
  return partial;
}

export class ShownFile extends FileState {
  /** A file whose splats Spark changes by a modifier and adds to a group. */
  constructor(file, modifier, group, changed, failed) {
    super(file, changed, failed);
    Object.assign(this, { modifier, group, mesh: null, loading: false, isTree: file.leaves !== null });
  }

  get paged() {
    return Boolean(this.mesh?.paged);
  }

  /** Loads the file; again, if it is there already. */
  async load() {
    this.unload();
    const { file } = this;
    const url = new URL(file.url, document.baseURI).href;
    Object.assign(this, { loading: true, bad: false });
    this.say(`loading ${size(0)} of ${size(file.bytes)}`);
    const pages = file.paged && (file.chunked || (await hasRanges(url)));
    const progress = (event) => this.loading && this.say(`loading ${size(event.loaded)} of ${size(file.bytes)}`);
    const atOnce = { fileType: file.type, extSplats: file.layout === 'ext', onProgress: progress, lod: this.builds || undefined };
    if (pages) this.say(`loading the first chunk, ${size(file.first_bytes)} of ${size(file.bytes)}`);
    const mesh = new SplatMesh({ url, objectModifier: this.modifier, ...(pages ? { paged: true, fileType: 'rad' } : atOnce) });
    this.mesh = mesh;
    mesh.visible = this.visible;
    this.group.add(mesh);
    try {
      await (pages ? this.firstChunk(mesh.paged) : mesh.initialized);
      if (this.mesh !== mesh) return;
      Object.assign(this, { loading: false, bad: false });
      this.say(this.described(pages));
    } catch (error) {
      if (this.mesh === mesh) this.fail(error);
    }
  }

  described(pages) {
    const { file } = this;
    const tree = this.isTree ? `tree of ${whole(file.splats)} nodes` : `${whole(file.splats)} splats`;
    const how = pages ? `, ${whole(file.chunks)} chunk${file.chunks > 1 ? 's' : ''}` : file.paged ? ', loaded whole: this host sends no ranges' : '';
    return `${file.format}, ${size(file.bytes)}, ${tree}${this.builds ? ', tree built here' : ''}${how}`;
  }

  /** Waits for the first chunk, and reports chunks that cannot be fetched, which Spark only writes to the console. */
  firstChunk(paged) {
    const fetchChunk = paged.fetchDecodeChunk.bind(paged);
    return new Promise((done, failed) => {
      paged.fetchDecodeChunk = async (chunk) => {
        try {
          const decoded = await fetchChunk(chunk);
          done();
          return decoded;
        } catch (error) {
          if (error.name !== 'AbortError') this.fail(error);
          throw error;
        }
      };
      paged.getRadMeta().catch(failed);
    });
  }

  show(visible) {
    if (this.mesh) this.mesh.visible = visible;
    super.show(visible);
  }

  unload() {
    if (!this.mesh) return;
    this.group.remove(this.mesh);
    this.mesh.dispose();
    this.mesh = null;
  }
}
