// Says what splat-transform makes of camera tracks: node camera_track.mjs PACKAGES FILE...
//
// A line of JSON for each file: how many frames a second, and the camera on every frame.

import { readFileSync } from 'node:fs';
import { pathToFileURL } from 'node:url';

const [packages, ...files] = process.argv.slice(2);
const url = pathToFileURL(`${packages}/node_modules/@playcanvas/splat-transform/dist/index.mjs`);
const { loadCameraTrack } = await import(url);
for (const file of files) {
    const track = loadCameraTrack(JSON.parse(readFileSync(file, 'utf8')), 60);
    const frames = Array.from({ length: track.frameCount }, (_, frame) => structuredClone(track.poseAt(frame)));
    console.log(JSON.stringify({ frameRate: track.frameRate, frames }));
}
