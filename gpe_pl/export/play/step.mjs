// One step of the learned simulator: graph, features, network, conservation of momentum, friction of walls, integration, containment.

import { Heap, kernelsOf } from "./kernels.mjs";
import { Network } from "./network.mjs";
import { contain } from "./shapes.mjs";

/** Call ``each(j, i, square)`` for pairs of a source j and a target i within the radius. Within one set of points, each pair once with j < i. */
export function pairsWithin(source, numSources, target, numTargets, radius, each) {
  const isJoint = source === target, square = radius * radius;
  let low0 = Infinity, low1 = Infinity, high0 = -Infinity, high1 = -Infinity;
  for (let n = 0; n < numTargets; n++) {
    low0 = Math.min(low0, target[2 * n]), high0 = Math.max(high0, target[2 * n]);
    low1 = Math.min(low1, target[2 * n + 1]), high1 = Math.max(high1, target[2 * n + 1]);
  }
  if (!Number.isFinite(high0 - low0 + high1 - low1)) return;
  const side = Math.max(radius, (high0 - low0) / 256, (high1 - low1) / 256);
  const columns = Math.floor((high0 - low0) / side) + 1, rows = Math.floor((high1 - low1) / side) + 1;
  const first = new Int32Array(columns * rows + 1), cell = new Int32Array(numTargets), sorted = new Int32Array(numTargets);
  for (let n = 0; n < numTargets; n++) {
    cell[n] = Math.floor((target[2 * n] - low0) / side) + columns * Math.floor((target[2 * n + 1] - low1) / side);
    first[cell[n] + 1]++;
  }
  for (let c = 0; c < columns * rows; c++) first[c + 1] += first[c];
  const next = first.slice(0, -1);
  for (let n = 0; n < numTargets; n++) sorted[next[cell[n]]++] = n;
  for (let j = 0; j < numSources; j++) {
    const x = source[2 * j], y = source[2 * j + 1];
    const column = Math.floor((x - low0) / side), row = Math.floor((y - low1) / side);
    for (let r = Math.max(row - 1, 0); r <= Math.min(row + 1, rows - 1); r++) {
      for (let c = Math.max(column - 1, 0); c <= Math.min(column + 1, columns - 1); c++) {
        for (let k = first[c + columns * r]; k < first[c + columns * r + 1]; k++) {
          const i = sorted[k];
          if (isJoint && i <= j) continue;
          const dx = target[2 * i] - x, dy = target[2 * i + 1] - y, d = dx * dx + dy * dy;
          if (d <= square) each(j, i, d);
        }
      }
    }
  }
}

/** A list of numbers that grows. */
class List {
  constructor() {
    this.values = new Int32Array(4096);
    this.length = 0;
  }

  push(a, b) {
    if (this.length + 2 > this.values.length) {
      const longer = new Int32Array(2 * this.values.length);
      longer.set(this.values);
      this.values = longer;
    }
    this.values[this.length++] = a;
    this.values[this.length++] = b;
  }
}

/** Boundary nodes on which something can rest: their slope is at most the angle of friction. */
function bearing(boundary, model) {
  const [x, y] = model.gravity, level = (1 - model.level) * Math.hypot(x, y);
  return Uint8Array.from({ length: boundary.count }, (_, b) => {
    const along = -(boundary.normal[2 * b] * x + boundary.normal[2 * b + 1] * y);
    return along > level / Math.sqrt(1 + Math.min(boundary.friction[b], 1e6) ** 2) ? 1 : 0;
  });
}

/** Connected groups of nodes, and whether each has an edge to a boundary node on which it can rest. */
function islandsOf(count, pairs, walls, bears) {
  const parent = Int32Array.from({ length: count }, (_, n) => n);
  const root = (n) => {
    while (parent[n] !== n) n = parent[n] = parent[parent[n]];
    return n;
  };
  for (let e = 0; e < pairs.length; e += 2) {
    const a = root(pairs.values[e]), b = root(pairs.values[e + 1]);
    parent[Math.max(a, b)] = Math.min(a, b);
  }
  const label = new Int32Array(count);
  let number = 0;
  for (let n = 0; n < count; n++) label[n] = parent[n] === n ? number++ : label[root(n)];
  const rests = new Uint8Array(number);
  for (let e = 1; e < walls.length; e += 2) {
    if (bears[walls.values[e - 1]]) rests[label[walls.values[e]]] = 1;
  }
  return { label, number, rests };
}

/** Strengths of the strongest edges of nodes, and of islands to the boundary: 1 near, and 0 at the radius. */
function tiesOf(state, boundary, pairs, walls, islands, model) {
  const { pos, count } = state, node = new Float64Array(count), wall = new Float64Array(islands.number);
  const strength = (from, b, i) => {
    const far = Math.hypot(pos[2 * i] - from[2 * b], pos[2 * i + 1] - from[2 * b + 1]) / model.radius;
    const t = Math.min(Math.max((1 - far) / (1 - model.fullStrength), 0), 1);
    return t * t * (3 - 2 * t);
  };
  for (let e = 0; e < pairs.length; e += 2) {
    const j = pairs.values[e], i = pairs.values[e + 1], own = strength(pos, j, i);
    node[j] = Math.max(node[j], own), node[i] = Math.max(node[i], own);
  }
  for (let e = 0; e < walls.length; e += 2) {
    const n = walls.values[e + 1], own = strength(boundary.pos, walls.values[e], n), k = islands.label[n];
    node[n] = Math.max(node[n], own), wall[k] = Math.max(wall[k], own);
  }
  return { node, wall };
}

/** Remove the part of accelerations that changes the momentum of islands in free flight; with ``angular`` also their angular momentum. */
function conserve(acc, state, islands, ties, angular) {
  const { label, number } = islands, { pos, count } = state;
  const mass = state.mass.map((m, n) => m * ties.node[n]), sum = new Float64Array(7 * number); // mass, x, y, ax, ay, moment, inertia
  for (let n = 0; n < count; n++) {
    const s = 7 * label[n], m = mass[n];
    sum[s] += m;
    sum[s + 1] += m * pos[2 * n], sum[s + 2] += m * pos[2 * n + 1];
    sum[s + 3] += m * acc[2 * n], sum[s + 4] += m * acc[2 * n + 1];
  }
  for (let s = 0; s < sum.length; s += 7) for (let k = 1; k < 5; k++) sum[s + k] = sum[s] > 0 ? sum[s + k] / sum[s] : 0;
  for (let n = 0; n < count; n++) {
    const s = 7 * label[n], x = pos[2 * n] - sum[s + 1], y = pos[2 * n + 1] - sum[s + 2];
    sum[s + 5] += mass[n] * (x * (acc[2 * n + 1] - sum[s + 4]) - y * (acc[2 * n] - sum[s + 3]));
    sum[s + 6] += mass[n] * (x * x + y * y);
  }
  for (let n = 0; n < count; n++) {
    const s = 7 * label[n], turn = angular && sum[s + 6] > 0 ? sum[s + 5] / sum[s + 6] : 0, free = 1 - ties.wall[label[n]];
    const x = pos[2 * n] - sum[s + 1], y = pos[2 * n + 1] - sum[s + 2], own = ties.node[n];
    acc[2 * n] = own * (acc[2 * n] - free * (sum[s + 3] - turn * y));
    acc[2 * n + 1] = own * (acc[2 * n + 1] - free * (sum[s + 4] + turn * x));
  }
}

/** Bring the forces of planes on islands that touch nothing else into their friction cones: planes push and rub, but hold nothing. */
function limit(acc, state, islands, walls, boundary, held, model) {
  const { label, number } = islands, { mass, count } = state;
  const sum = new Float64Array(7 * number); // edges, normal x and y, largest friction, mass, force x and y
  for (let e = 0; e < walls.length; e += 2) {
    const b = walls.values[e], s = 7 * label[walls.values[e + 1]];
    sum[s]++;
    sum[s + 1] += boundary.normal[2 * b], sum[s + 2] += boundary.normal[2 * b + 1];
    sum[s + 3] = Math.max(sum[s + 3], boundary.friction[b]);
  }
  for (let n = 0; n < count; n++) {
    const s = 7 * label[n];
    if (held && held.mask[n]) sum[s + 3] = Infinity;
    sum[s + 4] += mass[n];
    sum[s + 5] += mass[n] * acc[2 * n], sum[s + 6] += mass[n] * acc[2 * n + 1];
  }
  const change = new Float64Array(2 * number);
  for (let k = 0; k < number; k++) {
    const [edges, x, y, friction, total, fx, fy] = sum.subarray(7 * k, 7 * k + 7), length = Math.hypot(x, y);
    if (!edges || length <= (1 - model.alike) * edges || friction >= model.noSlip) continue;
    const nx = x / length, ny = y / length, along = (fx * nx + fy * ny) / total, tx = fx / total - along * nx, ty = fy / total - along * ny;
    const pushes = Math.max(along, 0), across = Math.hypot(tx, ty), share = across > 0 ? Math.min((friction * pushes) / across, 1) : 1;
    change[2 * k] = pushes * nx + share * tx - fx / total;
    change[2 * k + 1] = pushes * ny + share * ty - fy / total;
  }
  for (let n = 0; n < count; n++) for (let a = 0; a < 2; a++) acc[2 * n + a] += change[2 * label[n] + a];
}

/** A model that advances a state by one frame.
 *
 * A state has count, pos, vel and mass of its nodes, history (velocities, oldest first: [node, history, axis]) and params [node, parameter].
 */
export class Simulator {
  constructor(model, numbers, plain = false) {
    this.model = model;
    this.heap = new Heap();
    this.kernels = kernelsOf(this.heap, plain);
    this.network = new Network(this.heap, this.kernels, model.network, numbers);
  }

  /** Advance a state in place. Return numbers of nodes that containment moved, of edges and of islands.
   *
   * Nodes of ``held``, which has a mask of nodes and a displacement, move by this displacement whatever the model says.
   */
  step(state, boundary, shapes, held = null) {
    const { model } = this, { count } = state, pairs = new List(), walls = new List();
    pairsWithin(state.pos, count, state.pos, count, model.radius, (j, i) => pairs.push(j, i));
    pairsWithin(state.pos, count, boundary.pos, boundary.count, model.radius, (n, b) => walls.push(b, n));
    const touched = this.features(state, boundary, pairs, walls);
    this.network.compute([count, touched], [pairs.length / 2, walls.length / 2]);
    const { decoded } = this.network.room, values = this.heap.f32, acc = new Float64Array(2 * count);
    for (let n = 0; n < count; n++) {
      for (let a = 0; a < 2; a++) acc[2 * n + a] = values[decoded[0].at / 4 + n * decoded[0].columns + a];
    }
    const islands = islandsOf(count, pairs, walls, bearing(boundary, model));
    if (model.islandMomentum !== "ignored") {
      conserve(acc, state, islands, tiesOf(state, boundary, pairs, walls, islands, model), model.islandMomentum === "angular");
    }
    if (model.staticFriction > 0) limit(acc, state, islands, walls, boundary, held, model);
    this.integrate(state, acc, islands, held);
    const corrected = contain(shapes, state, model.frameDt);
    this.remember(state);
    return { corrected, edges: (pairs.length + walls.length) / 2, islands: islands.number };
  }

  /** Write the features of nodes and edges. Only boundary nodes with an edge take part; return their number. */
  features(state, boundary, pairs, walls) {
    const row = new Int32Array(boundary.count).fill(-1), nodes = [];
    for (let e = 0; e < walls.length; e += 2) {
      const b = walls.values[e];
      if (row[b] < 0) row[b] = nodes.push(b) - 1;
    }
    const room = this.network.reserve([state.count, nodes.length], [pairs.length / 2, walls.length / 2]);
    this.materialFeatures(state, room.x[0]);
    this.boundaryFeatures(boundary, nodes, room.x[1]);
    this.edgeFeatures(0, room, state, pairs, null, null);
    this.edgeFeatures(1, room, state, walls, boundary, row);
    return nodes.length;
  }

  materialFeatures(state, x) {
    const { model } = this, { nodes, params } = model.standards, values = this.heap.f32, past = model.history, history = state.history;
    const velocity = model.spacing / model.frameDt, acceleration = model.spacing / model.frameDt ** 2;
    for (let n = 0; n < state.count; n++) {
      const first = x.at / 4 + n * x.columns;
      let c = 0;
      const put = (value) => {
        values[first + c] = (Math.fround(value) - nodes.mean[c]) * nodes.inverse[c];
        c++;
      };
      for (let a = 0; a < 2; a++) put(history[2 * (n * past + past - 1) + a] / velocity);
      for (let s = past - 1; s > 0; s--) {
        for (let a = 0; a < 2; a++) put((history[2 * (n * past + s) + a] - history[2 * (n * past + s - 1) + a]) / velocity);
      }
      for (let a = 0; a < 2; a++) put(model.gravity[a] / acceleration);
      if (c === x.columns) continue;
      model.parameters.forEach((parameter, k) => {
        const value = Math.min(Math.max(state.params[n * model.parameters.length + k], parameter.low), parameter.high);
        values[first + c + k] = ((parameter.isLog ? Math.log(value) : value) - params.mean[k]) * params.inverse[k];
      });
    }
  }

  boundaryFeatures(boundary, nodes, x) {
    const { mean, inverse } = this.model.standards.boundary, values = this.heap.f32;
    nodes.forEach((b, r) => {
      const friction = boundary.friction[b];
      const own = [0, 0, boundary.normal[2 * b], boundary.normal[2 * b + 1], friction / (1 + friction), boundary.restitution[b]];
      own.forEach((value, c) => (values[x.at / 4 + r * x.columns + c] = (Math.fround(value) - mean[c]) * inverse[c]));
    });
  }

  /** Write the features of a relation's edges. Edges between particles point to the end with the larger x, then y. */
  edgeFeatures(relation, room, state, pairs, boundary, row) {
    const { model } = this, { mean, inverse } = model.standards.edges[relation], { f32, i32 } = this.heap;
    const velocity = model.spacing / model.frameDt, tiny = (model.tiny * model.spacing) ** 2, x = room.features[relation];
    const from = boundary || state, sourceVel = boundary ? null : state.vel;
    for (let e = 0; e < pairs.length / 2; e++) {
      let j = pairs.values[2 * e], i = pairs.values[2 * e + 1];
      let dx = state.pos[2 * i] - from.pos[2 * j], dy = state.pos[2 * i + 1] - from.pos[2 * j + 1];
      let vx = (state.vel[2 * i] - (sourceVel ? sourceVel[2 * j] : 0)) / velocity;
      let vy = (state.vel[2 * i + 1] - (sourceVel ? sourceVel[2 * j + 1] : 0)) / velocity;
      if (!boundary && (dx || dy || vx || vy) < 0) [j, i, dx, dy, vx, vy] = [i, j, -dx, -dy, -vx, -vy];
      const distance = Math.sqrt(dx * dx + dy * dy + tiny), ux = dx / distance, uy = dy / distance;
      const gap = (distance / model.spacing - 1) / model.gapScale, nx = boundary ? boundary.normal[2 * j] : 0, ny = boundary ? boundary.normal[2 * j + 1] : 0;
      const own = [
        dx / model.radius, dy / model.radius, ux, uy, vx, vy,
        Math.min(Math.max(gap, -model.gapLimit), model.gapLimit), vx * ux + vy * uy, (dx * nx + dy * ny) / model.spacing, vx * nx + vy * ny,
      ];
      const first = x.at / 4 + e * x.columns;
      for (let c = 0; c < 10; c++) f32[first + c] = (Math.fround(own[c]) - mean[c]) * inverse[c];
      i32[room.source[relation] / 4 + e] = boundary ? row[j] : j;
      i32[room.target[relation] / 4 + e] = i;
    }
  }

  /** Move nodes with symplectic Euler. Slow nodes of islands on walls keep their positions. */
  integrate(state, acc, islands, held) {
    const { model } = this, dt = model.frameDt, { pos, vel } = state, unit = model.accelerationStd;
    const slowest = (model.staticFriction * dt * Math.hypot(...model.gravity)) ** 2;
    for (let n = 0; n < state.count; n++) {
      const vx = vel[2 * n] + (model.gravity[0] + acc[2 * n] * unit) * dt, vy = vel[2 * n + 1] + (model.gravity[1] + acc[2 * n + 1] * unit) * dt;
      const wasSlow = vel[2 * n] ** 2 + vel[2 * n + 1] ** 2 < slowest;
      const stays = wasSlow && vx * vx + vy * vy < slowest && islands.rests[islands.label[n]];
      vel[2 * n] = stays ? 0 : vx;
      vel[2 * n + 1] = stays ? 0 : vy;
      if (held && held.mask[n]) for (let a = 0; a < 2; a++) vel[2 * n + a] = held.move[a] / dt;
      pos[2 * n] += vel[2 * n] * dt;
      pos[2 * n + 1] += vel[2 * n + 1] * dt;
    }
  }

  /** Append the velocities to the history. */
  remember(state) {
    const past = this.model.history, { history, vel } = state;
    for (let n = 0; n < state.count; n++) {
      const first = 2 * n * past;
      history.copyWithin(first, first + 2, first + 2 * past);
      history[first + 2 * past - 2] = vel[2 * n];
      history[first + 2 * past - 1] = vel[2 * n + 1];
    }
  }
}
