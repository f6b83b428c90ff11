// Errors that the engine does not hand to the page: it throws them where nobody catches them, or writes them to the console.
import { listFaults } from './panel.js';

/** Different errors that the panel lists; an engine may repeat one in every frame. */
const MOST = 5;

const counts = new Map(); // of errors, by their text

function report(error) {
  if (error?.name === 'AbortError') return; // of a file that is no longer loaded
  const text = String(error instanceof Error ? error : (error?.message ?? error));
  counts.set(text, (counts.get(text) ?? 0) + 1);
  listFaults([...counts].slice(0, MOST).map(([each, count]) => (count > 1 ? `${each} (${count.toLocaleString('en')} times)` : each)));
}

/** Shows errors in the panel from now on, and leaves them in the console. */
export function watchFaults() {
  // Events without an error are not of scripts: a ResizeObserver that has more to say in the next frame.
  window.addEventListener('error', ({ error }) => error && report(error));
  window.addEventListener('unhandledrejection', ({ reason }) => report(reason));
  const write = console.error.bind(console);
  console.error = (...values) => {
    write(...values);
    report(values.find((value) => value instanceof Error) ?? values.join(' '));
  };
}
