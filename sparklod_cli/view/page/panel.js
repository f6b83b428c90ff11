// The panel: what it shows, and what happens when somebody uses it. Knows nothing of Spark.

export const element = (id) => document.getElementById(id);

/** Says that the page cannot go on. */
export function fail(text) {
  tell(text, false);
  element('panel').hidden = true;
}

/** Says what the page waits for before it can draw. */
export function starting(text) {
  element('message-text').textContent = `Starting. ${text}`;
}

/** Says something at the bottom, until it is closed. */
export function notice(text) {
  tell(text, true);
}

function tell(text, closes) {
  element('message').hidden = false;
  element('message').classList.toggle('notice', closes);
  element('message-text').textContent = text;
  element('message-close').hidden = !closes;
}

export function clearMessage() {
  element('message').hidden = true;
}

element('message-close').addEventListener('click', clearMessage);

/** Shows the panel, or hides it behind its button. */
export function showPanel(shown) {
  element('panel').hidden = !shown;
  element('panel-show').hidden = shown;
}

/** The width and height in pixels that the panel covers: at the side, or below where it is as wide as the window. */
export function covered() {
  const { left, top, width } = element('panel').getBoundingClientRect();
  if (!width) return [0, 0]; // hidden
  return width > window.innerWidth / 2 ? [0, window.innerHeight - top] : [window.innerWidth - left, 0];
}

/** Says which files are loading, and how much of them is there. */
export function listLoading(shown) {
  const loading = shown.filter((file) => file.loading && file.visible);
  element('loading').hidden = !loading.length;
  element('loading').textContent = loading.map((file) => `${file.file.name}: ${file.state}`).join(', ');
}

/** A row for each file, with a box that shows and hides it; returns what updates a row. */
export function listFiles(shown, onShow) {
  const rows = shown.map((file) => {
    const [item, label, box, name, state] = ['li', 'label', 'input', 'span', 'small'].map((tag) => document.createElement(tag));
    box.type = 'checkbox';
    box.checked = true;
    box.addEventListener('change', () => onShow(file, box.checked));
    name.className = 'name';
    name.textContent = name.title = file.file.name;
    label.append(box, name, state);
    item.append(label);
    return { item, state };
  });
  element('files').replaceChildren(...rows.map((row) => row.item));
  return (file) => {
    listLoading(shown);
    const { state } = rows[shown.indexOf(file)];
    state.textContent = file.state;
    state.classList.toggle('bad', file.bad);
  };
}

/** Lists errors of the engine. */
export function listFaults(texts) {
  element('faults').hidden = !texts.length;
  element('faults').replaceChildren(...texts.map((text) => Object.assign(document.createElement('li'), { textContent: text })));
}

/** Fills the legend of the levels. */
export function drawLegend({ colors, marks, text }) {
  const filled = (tag, fill) => (value) => {
    const field = document.createElement(tag);
    fill(field, value);
    return field;
  };
  element('legend-bar').replaceChildren(...colors.map(filled('i', (field, color) => (field.style.background = color))));
  element('legend-marks').replaceChildren(...marks.map(filled('span', (field, mark) => (field.textContent = mark))));
  element('legend-text').textContent = text;
}

/** Calls functions by the ids of buttons and boxes, and by keys. */
export function listen(clicks, changes, keys, move) {
  for (const [id, act] of Object.entries(clicks)) element(id).addEventListener('click', act);
  for (const [id, act] of Object.entries(changes)) element(id).addEventListener('input', (event) => act(event.target));
  const typing = (event) => event.target.matches('input:not([readonly], [type="checkbox"], [type="range"]), select');
  window.addEventListener('keydown', (event) => {
    if (typing(event) || event.ctrlKey || event.metaKey || event.altKey || element('help').open) return;
    const act = keys[event.key.toLowerCase()];
    const onControl = event.target.matches('button, input[type="range"], input[type="checkbox"]');
    if (act && !(onControl && event.key === ' ')) {
      event.preventDefault();
      act();
    } else if (!(onControl && event.key.startsWith('Arrow')) && move(event, true)) {
      event.preventDefault();
    }
  });
  window.addEventListener('keyup', (event) => move(event, false));
}

/** Calls a function with the files that somebody drops onto the page, or chooses. */
export function onDrop(act) {
  let depth = 0;
  const mark = (change) => {
    depth = Math.max(0, depth + change);
    document.body.classList.toggle('dropping', depth > 0);
  };
  window.addEventListener('dragenter', () => mark(1));
  window.addEventListener('dragleave', () => mark(-1));
  window.addEventListener('dragover', (event) => event.preventDefault());
  window.addEventListener('drop', (event) => {
    event.preventDefault();
    mark(-depth);
    if (event.dataTransfer.files.length) act([...event.dataTransfer.files]);
  });
  const input = element('path-files');
  element('choose').addEventListener('click', () => input.click());
  input.addEventListener('change', () => {
    if (input.files.length) act([...input.files]);
    input.value = '';
  });
}

/** Copies the text of a field; false where the browser does not let us. */
export async function copyField(field) {
  field.select();
  try {
    await navigator.clipboard.writeText(field.value);
    return true;
  } catch {
    return document.execCommand('copy');
  }
}
