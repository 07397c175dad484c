// What is on the page: blocks of particles, walls and obstacles, and the hand that moves them.
//
// Lengths and speeds are those of a domain of 1 m. ``unit`` and ``pace`` of a world are its lengths and speeds over these.

import { Simulator } from "./step.mjs";
import { boundaryOf, distanceTo, nearest } from "./shapes.mjs";

export const REACH = 0.15; // of the hand [m]
const SLOWEST_RELEASE = 0.02, FASTEST_HAND = 2.5, FASTEST_OBSTACLE = 0.6; // [m/s]
const FOLLOWS_IN = 0.04; // time in which the hand follows the pointer [s]
const MOST_NODES = 1500;
const RADIUS = 0.09, NEAR = 0.05, MARGIN = 0.02; // of a new obstacle; of the node that is picked; of obstacles from walls [m]
const JITTER = 0.25; // of new blocks [spacings]
const NOTHING = { corrected: 0, edges: 0, islands: 0 }; // what a step without particles does
const EXPLODED = 50; // speed at which the model has failed [m/s]
const OBSTACLE_FRICTION = 0.4;

const PER_NODE = { pos: 2, vel: 2, mass: 1, block: 1 };

export class World {
  constructor(model, numbers) {
    this.model = model;
    this.simulator = new Simulator(model, numbers);
    this.parameters = model.parameters.map(({ low, high }) => (low + high) / 2);
    const [[left, right], [bottom, top]] = model.bounds;
    this.unit = Math.min(right - left, top - bottom);
    this.pace = Math.sqrt((this.unit * (Math.hypot(...model.gravity) || 9.81)) / 9.81); // of what falls through the domain
    this.reset();
  }

  /** Return to the scene of the model's file, or to a block above an obstacle. */
  reset(scene = this.scene || null) {
    const { model } = this;
    this.scene = scene;
    Object.assign(this, { time: 0, hand: null, problem: "", untouched: Boolean(scene), last: NOTHING });
    this.state = { count: 0, pos: new Float64Array(0), vel: new Float64Array(0), mass: new Float64Array(0), block: new Float64Array(0) };
    this.state.history = new Float64Array(0);
    this.state.params = new Float64Array(0);
    this.numBlocks = 0;
    if (scene) {
      this.shapes = scene.shapes.map((shape) => ({ ...shape }));
      this.append(scene.count, { pos: scene.pos, vel: scene.vel, mass: scene.mass, history: scene.history, params: scene.params });
      this.parameters = scene.params.slice(0, model.parameters.length);
    } else {
      this.shapes = boxWalls(model.bounds);
      const [[left, right], [bottom, top]] = model.bounds, at = (x, y) => [left + x * (right - left), bottom + y * (top - bottom)];
      this.addObstacle(...at(0.66, 0.24));
      this.addBlock(...at(0.25, 0.35), 0.22 * this.unit);
      this.addBlock(...at(0.6, 0.68), 0.18 * this.unit);
    }
    this.resample();
  }

  resample() {
    this.boundary = boundaryOf(this.shapes, this.model.spacing);
  }

  get obstacles() {
    return this.shapes.filter((shape) => shape.kind !== "wall" && shape.kind !== "bowl");
  }

  // --- nodes -----------------------------------------------------------------------------------------------------------------------------------

  append(count, values) {
    const { state, model } = this, old = state.count, block = this.numBlocks++;
    const sizes = { ...PER_NODE, history: 2 * model.history, params: model.parameters.length };
    for (const [name, size] of Object.entries(sizes)) {
      const longer = new Float64Array((old + count) * size);
      longer.set(state[name]);
      if (values[name]) longer.set(values[name], old * size);
      else if (name === "block") longer.fill(block, old);
      state[name] = longer;
    }
    state.count = old + count;
  }

  keep(isKept) {
    const { state, model } = this, rows = [];
    for (let n = 0; n < state.count; n++) if (isKept(n)) rows.push(n);
    const sizes = { ...PER_NODE, history: 2 * model.history, params: model.parameters.length };
    for (const [name, size] of Object.entries(sizes)) {
      const kept = new Float64Array(rows.length * size);
      rows.forEach((n, row) => kept.set(state[name].subarray(n * size, (n + 1) * size), row * size));
      state[name] = kept;
    }
    state.count = rows.length;
    if (!state.count) this.last = NOTHING;
    this.hand = null;
  }

  setParameters(values) {
    this.parameters = [...values];
    for (let n = 0; n < this.state.count; n++) this.state.params.set(values, n * values.length);
  }

  /** Add a square block at rest around a point, where there is room. Return the number of its nodes. */
  addBlock(x, y, size) {
    const { model, state } = this, spacing = model.spacing, side = Math.max(2, Math.round(size / spacing)), pos = [];
    const random = generator(1 + this.numBlocks);
    const isFree = (px, py) => {
      if (nearest(this.shapes, px, py) < 0.45 * spacing) return false;
      for (let n = 0; n < state.count; n++) if (Math.hypot(state.pos[2 * n] - px, state.pos[2 * n + 1] - py) < 0.8 * spacing) return false;
      return true;
    };
    for (let row = 0; row < side; row++) {
      for (let column = 0; column < side; column++) {
        const px = x + (column - (side - 1) / 2 + JITTER * (2 * random() - 1)) * spacing;
        const py = y + (row - (side - 1) / 2 + JITTER * (2 * random() - 1)) * spacing;
        if (isFree(px, py) && state.count + pos.length / 2 < MOST_NODES) pos.push(px, py);
      }
    }
    const count = pos.length / 2;
    if (!count) return 0;
    const params = Array(count).fill(this.parameters).flat();
    this.append(count, { pos, mass: new Float64Array(count).fill(model.nodeMass), params });
    this.untouched = false;
    return count;
  }

  addObstacle(x, y) {
    const radius = RADIUS * this.unit, gap = radius + 2 * this.model.spacing;
    const center = this.model.bounds.map(([low, high], a) => clamped([x, y][a], low + gap, high - gap));
    this.shapes = [...this.shapes, { kind: "sphere", center, radius, friction: OBSTACLE_FRICTION, restitution: 0 }];
    this.untouched = false;
    this.resample();
  }

  /** Remove the obstacle at a point, or the block of the nearest node. Return what was removed. */
  removeAt(x, y) {
    const obstacle = this.obstacleAt(x, y);
    if (obstacle) {
      this.untouched = false;
      this.shapes = this.shapes.filter((shape) => shape !== obstacle);
      this.resample();
      return "obstacle";
    }
    const node = this.nodeAt(x, y);
    if (node < 0) return "";
    this.untouched = false;
    const block = this.state.block[node];
    this.keep((n) => this.state.block[n] !== block);
    return "block";
  }

  obstacleAt(x, y) {
    return this.obstacles.find((shape) => distanceTo(shape, x, y) < 0) || null;
  }

  nodeAt(x, y) {
    const { state } = this;
    let found = -1, least = NEAR * this.unit;
    for (let n = 0; n < state.count; n++) {
      const d = Math.hypot(state.pos[2 * n] - x, state.pos[2 * n + 1] - y);
      if (d < least) [found, least] = [n, d];
    }
    return found;
  }

  // --- the hand --------------------------------------------------------------------------------------------------------------------------------

  /** Take hold of an obstacle, or of the nodes of a block within reach. Return what is held. */
  grab(x, y) {
    const obstacle = this.obstacleAt(x, y), { state } = this;
    const hand = { at: [x, y], pointer: [x, y], velocity: [0, 0] };
    if (obstacle) {
      this.hand = { ...hand, obstacle };
      return "obstacle";
    }
    const node = this.nodeAt(x, y);
    if (node < 0) return "";
    const mask = new Uint8Array(state.count);
    for (let n = 0; n < state.count; n++) {
      mask[n] = state.block[n] === state.block[node] && Math.hypot(state.pos[2 * n] - x, state.pos[2 * n + 1] - y) < REACH * this.unit;
    }
    this.hand = { ...hand, mask };
    return "block";
  }

  point(x, y) {
    if (this.hand) this.hand.pointer = [x, y];
  }

  /** Let go. Return the speed at which a block was thrown [m/s]. */
  release() {
    const { hand } = this;
    this.hand = null;
    if (!hand || !hand.mask) return 0;
    const speed = Math.hypot(...hand.velocity);
    return speed < SLOWEST_RELEASE * this.pace ? 0 : speed;
  }

  /** Return how far the hand moves in a step [m]. */
  handMove(fastest) {
    const dt = this.model.frameDt, { at, pointer } = this.hand;
    const velocity = [0, 1].map((a) => (pointer[a] - at[a]) / Math.max(FOLLOWS_IN, dt)), speed = Math.hypot(...velocity);
    const factor = speed > fastest ? fastest / speed : 1;
    this.hand.velocity = velocity.map((v) => v * factor);
    return this.hand.velocity.map((v) => v * dt);
  }

  moveObstacle() {
    const { obstacle, at } = this.hand, move = this.handMove(FASTEST_OBSTACLE * this.pace), margin = MARGIN * this.unit;
    const moved = translated(obstacle, move);
    const inside = this.model.bounds.every(([low, high], a) => center(moved)[a] > low + margin && center(moved)[a] < high - margin);
    if (!inside) return;
    this.shapes = this.shapes.map((shape) => (shape === obstacle ? moved : shape));
    this.hand.obstacle = moved;
    this.hand.at = [at[0] + move[0], at[1] + move[1]];
    this.resample();
  }

  // --- time ------------------------------------------------------------------------------------------------------------------------------------

  /** Advance by one frame of the model. Return false, with the reason in ``problem``, if the model has failed. */
  step() {
    if (this.problem) return false;
    let held = null;
    if (this.hand) {
      this.untouched = false;
      if (this.hand.obstacle) this.moveObstacle();
      else {
        held = { mask: this.hand.mask, move: this.handMove(FASTEST_HAND * this.pace) };
        this.hand.at = this.hand.at.map((value, a) => value + held.move[a]);
      }
    }
    if (this.state.count) this.last = this.simulator.step(this.state, this.boundary, this.shapes, held);
    this.time += this.model.frameDt;
    for (const v of this.state.vel) {
      if (!(Math.abs(v) < EXPLODED * this.pace)) {
        this.problem = Number.isFinite(v) ? "The model has failed: particles fly apart." : "The model has failed: a velocity is not a number.";
        return false;
      }
    }
    return true;
  }

  /** Kinetic and potential energy [J per metre of depth]. The energy of deformation is not known. */
  energies() {
    const { state, model } = this, floor = model.bounds[1][0];
    let kinetic = 0, potential = 0, fastest = 0;
    for (let n = 0; n < state.count; n++) {
      const square = state.vel[2 * n] ** 2 + state.vel[2 * n + 1] ** 2;
      kinetic += 0.5 * state.mass[n] * square;
      potential -= state.mass[n] * (model.gravity[0] * state.pos[2 * n] + model.gravity[1] * (state.pos[2 * n + 1] - floor));
      fastest = Math.max(fastest, square);
    }
    return { kinetic, potential, fastest: Math.sqrt(fastest) };
  }
}

/** Return the value between two limits that is nearest to a value; the middle if there is none between them. */
function clamped(value, low, high) {
  return low > high ? (low + high) / 2 : Math.min(Math.max(value, low), high);
}

export function center(shape) {
  if (shape.center) return shape.center;
  if (shape.low) return [0, 1].map((a) => (shape.low[a] + shape.high[a]) / 2);
  return [0, 1].map((a) => shape.vertices.reduce((sum, v) => sum + v[a], 0) / shape.vertices.length);
}

function translated(shape, move) {
  const moved = (point) => point.map((value, a) => value + move[a]);
  if (shape.center) return { ...shape, center: moved(shape.center) };
  if (shape.low) return { ...shape, low: moved(shape.low), high: moved(shape.high) };
  return { ...shape, vertices: shape.vertices.map(moved) };
}

function boxWalls([[left, right], [bottom, top]]) {
  const common = { kind: "wall", low: [left, bottom], high: [right, top], friction: OBSTACLE_FRICTION, restitution: 0 };
  const sides = [[[1, 0], left], [[-1, 0], -right], [[0, 1], bottom], [[0, -1], -top]];
  return sides.map(([normal, offset]) => ({ ...common, normal, offset }));
}

/** A small generator of random numbers in [0, 1), so that a scene is the same every time. */
function generator(seed) {
  let value = (seed * 7919) % 2147483647;
  return () => (value = (value * 16807) % 2147483647) / 2147483647;
}
