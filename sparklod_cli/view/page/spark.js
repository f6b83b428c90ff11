// Spark in a canvas: what view.js draws trees and plain splats with.
import { Group, Scene, WebGLRenderer } from 'three';
import { SparkRenderer } from '@sparkjsdev/spark';
import { ShownFile } from './scene.js';
import { SizeColors } from './sizes.js';

export class Stage {
  constructor(canvas, { start: { sizes }, files }) {
    this.renderer = new WebGLRenderer({ canvas, antialias: false });
    // All paged files share the layout of the pages.
    const pagedExtSplats = files.every(({ paged, layout }) => !paged || layout === 'ext');
    this.spark = new SparkRenderer({ renderer: this.renderer, accumExtSplats: true, pagedExtSplats });
    this.group = new Group();
    this.scene = new Scene();
    this.scene.add(this.spark, this.group);
    this.colors = new SizeColors(sizes);
    this.files = [];
  }

  /** A file to be loaded; `changed` is called when its state changes, `failed` with what went wrong. */
  add(file, changed, failed) {
    this.files.push(new ShownFile(file, this.colors.modifier, this.group, changed, failed));
    return this.files.at(-1);
  }

  /** Turns all files. */
  turn(quaternion) {
    this.group.quaternion.copy(quaternion);
    this.group.updateMatrixWorld(true);
  }

  resize(ratio, width, height) {
    this.renderer.setPixelRatio(ratio);
    this.renderer.setSize(width, height, false);
  }

  /** Calls a function before each frame, with the time in milliseconds. */
  loop(act) {
    this.renderer.setAnimationLoop(act);
  }

  draw(camera) {
    this.renderer.render(this.scene, camera);
  }

  /** Splats in the last frame. */
  get drawn() {
    return this.spark.activeSplats;
  }

  get defaultBudget() {
    return this.spark.defaultSplatTarget();
  }

  set budget(splats) {
    this.spark.lodSplatCount = splats;
  }

  get colorsByLevel() {
    return this.colors.on;
  }

  set colorsByLevel(on) {
    this.colors.on = on;
    for (const { mesh } of this.files) mesh?.updateVersion();
  }

  /** The colours of levels, some marks below them, and what they are. */
  get legend() {
    const text = 'Feature size of each splat, in world units; a colour is a factor of two. Coarse levels of a tree have large splats.';
    return { ...this.colors.legend(), text };
  }

  /** How many chunks are resident, and how many there are; null where nothing is loaded by chunks. */
  get chunks() {
    const paged = this.files.filter((shown) => shown.paged);
    const resident = this.spark.pager?.pageToSplatsChunk.filter(Boolean).length ?? 0;
    return paged.length ? [resident, paged.reduce((sum, { file }) => sum + file.chunks, 0)] : null;
  }
}
