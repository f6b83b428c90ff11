// A file as the panel lists it, whatever draws it.

export class FileState {
  /**
   * @param file as view.json has it.
   * @param changed is called when its state changes.
   * @param failed is called with what went wrong.
   */
  constructor(file, changed, failed) {
    Object.assign(this, { file, changed, failed, visible: true, builds: false, isTree: true, loading: true, bad: false, state: '' });
  }

  say(state) {
    if (this.bad || state === this.state) return;
    this.state = state;
    this.changed(this);
  }

  show(visible) {
    this.visible = visible;
    this.changed(this);
  }

  fail(error) {
    const text = String(error?.message ?? error);
    Object.assign(this, { loading: false, bad: true, state: `cannot be shown: ${text}` });
    this.changed(this);
    this.failed(`${this.file.name} ${this.state}`);
  }
}
