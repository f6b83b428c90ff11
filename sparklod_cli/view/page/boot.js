// Starts the page, or says why it cannot start: no WebGL 2, or no libraries.
import { watchFaults } from './faults.js';
import { fail, starting } from './panel.js';

watchFaults();

const read = async (name) => {
  const response = await fetch(name);
  if (!response.ok) throw new Error(`${name}: ${response.status} ${response.statusText}`);
  return response.json();
};

async function boot() {
  const settings = await read('./view.json').catch((error) => {
    throw new Error(`What to show cannot be read: ${error.message}. Is the server still running?`);
  });
  if (!document.createElement('canvas').getContext('webgl2')) {
    throw new Error('This browser has no WebGL 2, which splats are drawn with. Use another one, or switch on hardware acceleration.');
  }
  const { source, versions } = settings.libraries;
  const names = Object.entries(versions).map(([name, version]) => `${name} ${version}`);
  starting(`Loading ${names.join(' and ')} from ${source}.`);
  // Imported late, as a module that cannot be loaded would otherwise take this one with it.
  const modules = ['./view.js', `./${settings.engine}.js`].map((name) => import(name));
  const [{ view }, { Stage }] = await Promise.all(modules).catch((error) => {
    throw new Error(
      `${names.join(' and ')} cannot be loaded from ${source} (${error.message}). ` +
        'Without a network, start sparklod view with --spark-dir.',
    );
  });
  await view(settings, Stage);
}

boot().catch((error) => {
  console.error(error);
  fail(error.message);
});
