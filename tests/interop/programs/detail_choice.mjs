// Answers requests, one line of JSON each, with the detail levels that PlayCanvas's own modules choose.

import { createInterface } from "node:readline";
import { pathToFileURL } from "node:url";

const source = `${process.argv[2]}/node_modules/playcanvas/build/playcanvas/src`;
const load = (path) => import(pathToFileURL(`${source}/${path}`).href);
const { GSplatOctree } = await load("scene/gsplat-unified/gsplat-octree.js");
const { GSplatOctreeInstance } = await load("scene/gsplat-unified/gsplat-octree-instance.js");
const { GSplatBudgetBalancer } = await load("scene/gsplat-unified/gsplat-budget-balancer.js");
const { GSplatPlacement } = await load("scene/gsplat-unified/gsplat-placement.js");
const { Mat4 } = await load("core/math/mat4.js");
const { Vec3 } = await load("core/math/vec3.js");

// A node of the scene graph, as far as the modules ask it.
function graphNode(columnMajor) {
  const matrix = new Mat4().set(columnMajor);
  return {
    getWorldTransform: () => matrix,
    getPosition: () => matrix.getTranslation(new Vec3()),
    get forward() {
      return matrix.getZ(new Vec3()).normalize().mulScalar(-1);
    },
  };
}

function answer({ manifests, cameras, budgets, mode, params }) {
  const instances = new Map();
  for (const { data, matrix, settings } of manifests) {
    const octree = new GSplatOctree("http://a.test/lod-meta.json", data);
    const placement = new GSplatPlacement(null, graphNode(matrix));
    Object.assign(placement, settings);
    instances.set(placement, new GSplatOctreeInstance({ on: () => ({ off() {} }) }, octree, placement));
  }
  const balancer = new GSplatBudgetBalancer();
  return cameras.map(({ matrix, fov, aspectRatio }) => {
    const camera = Object.assign(graphNode(matrix), { camera: { fov, aspectRatio, horizontalFov: false, projection: 0 } });
    for (const instance of instances.values()) {
      instance.resolveLodRange();
      instance.evaluateNodeDistances(camera, params);
    }
    return {
      distances: [...instances.values()].map((each) => each.nodeInfos.map((info) => info.worldDistanceSq)),
      levels: budgets.map((budget) => {
        balancer.balance(instances, budget, mode === "limit");
        return [...instances.values()].map((each) => each.nodeInfos.map((info) => info.optimalLod));
      }),
    };
  });
}

for await (const line of createInterface({ input: process.stdin })) {
  let reply;
  try {
    reply = { found: answer(JSON.parse(line)) };
  } catch (error) {
    reply = { error: `${error.stack ?? error}` };
  }
  process.stdout.write(`${JSON.stringify(reply)}\n`);
}
