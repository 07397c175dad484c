// The network: encoders, message passing and decoder. ``export/play_model.py`` describes its arrays.

import { COLUMNS, Matrix, ROWS, padded } from "./kernels.mjs";

/** A matrix of weights on the heap: address, and number of rows. Rows are padded to a multiple of 8 columns. */
class Weight {
  constructor(heap, numbers, [first, rows, columns]) {
    const width = padded(columns, COLUMNS);
    this.rows = rows;
    this.at = heap.take(rows * width);
    for (let r = 0; r < rows; r++) heap.f32.set(numbers.subarray(first + r * columns, first + (r + 1) * columns), this.at / 4 + r * width);
  }
}

const isPlace = (value) => Array.isArray(value) && value.length === 3 && value.every(Number.isInteger);

/** Return a copy of a description with weights in place of their places in the file. */
function withWeights(value, heap, numbers) {
  if (isPlace(value)) return new Weight(heap, numbers, value);
  if (Array.isArray(value)) return value.map((item) => withWeights(item, heap, numbers));
  if (value === null || typeof value !== "object") return value;
  return Object.fromEntries(Object.entries(value).map(([key, item]) => [key, withWeights(item, heap, numbers)]));
}

/** Room for the nodes of one type and the edges of each relation; made again where a graph has more. */
class Room {
  constructor(heap, network, nodes, edges) {
    const { hidden } = network;
    this.nodes = nodes.map((count) => padded(Math.ceil(1.25 * count) + 4, ROWS));
    this.edges = edges.map((count) => padded(Math.ceil(1.25 * count) + 4, ROWS));
    const nodeMatrix = (type, columns) => new Matrix(heap, this.nodes[type], columns);
    this.x = network.types.map((t, type) => nodeMatrix(type, t.channels));
    [this.h, this.z, this.y] = [0, 1, 2].map(() => network.types.map((_, type) => nodeMatrix(type, hidden)));
    this.decoded = network.types.map((_, type) => nodeMatrix(type, COLUMNS));
    this.features = network.relations.map((r, k) => new Matrix(heap, this.edges[k], r.channels));
    this.state = new Matrix(heap, Math.max(...this.edges), hidden);
    this.source = this.edges.map((count) => heap.take(count));
    this.target = this.edges.map((count) => heap.take(count));
    // of each relation and end: products of node states, and sums of activations; the column after the last has the signed number of edges
    const atEnds = (columns) => network.relations.map((r) => ({ target: nodeMatrix(r.target, columns), source: nodeMatrix(r.source, columns) }));
    this.products = atEnds(hidden);
    this.sums = atEnds(hidden + 1);
    network.relations.forEach((r, k) => {
      if (r.source === r.target) this.sums[k].source = this.sums[k].target;
    });
  }

  holds(nodes, edges) {
    return nodes.every((count, type) => count <= this.nodes[type]) && edges.every((count, k) => count <= this.edges[k]);
  }
}

export class Network {
  constructor(heap, kernels, description, numbers) {
    Object.assign(this, { heap, kernels, room: null, ...withWeights(description, heap, numbers) });
  }

  /** Make room for a graph with so many nodes of each type and edges of each relation; the features then go into ``room``. */
  reserve(nodes, edges) {
    if (!this.room || !this.room.holds(nodes, edges)) this.room = new Room(this.heap, this, nodes, edges);
    return this.room;
  }

  /** Multiply rows by a matrix; add the bias, or what is there where the bias is null; then apply the activation with this slope. */
  multiply(out, x, rows, weight, bias, slope = 1) {
    this.kernels.product(out.at, out.stride, x.at, x.stride, weight.at, rows, weight.rows, out.stride, bias ? bias.at : 0, slope);
  }

  /** Write the values of a two-layer function whose first product is in z. Adds them to h where ``adds``. */
  finish(h, z, y, rows, layer, adds) {
    this.multiply(y, z, rows, layer.last, layer.lastBias);
    const values = this.heap.f32, hidden = this.hidden, width = y.columns;
    const gain = layer.gain && layer.gain.at / 4, shift = layer.gain && layer.shift.at / 4;
    for (let r = 0; r < rows; r++) {
      const from = y.at / 4 + r * width, to = h.at / 4 + r * width;
      let mean = 0, square = 0, scale = 1;
      if (layer.gain) {
        for (let c = 0; c < hidden; c++) mean += values[from + c];
        mean /= hidden;
        for (let c = 0; c < hidden; c++) square += (values[from + c] - mean) ** 2;
        scale = 1 / Math.sqrt(square / hidden + this.epsilon);
      }
      for (let c = 0; c < hidden; c++) {
        const value = layer.gain ? (values[from + c] - mean) * scale * values[gain + c] + values[shift + c] : values[from + c];
        values[to + c] = adds ? values[to + c] + value : value;
      }
    }
  }

  /** Compute the outputs of a graph, whose features and edges are in ``room``; they are then in ``room.decoded``. */
  compute(nodes, edges) {
    const { room, kernels } = this, width = room.state.stride;
    this.countEdges(edges);
    nodes.forEach((rows, type) => {
      const layer = this.encoders[type];
      this.multiply(room.z[type], room.x[type], rows, layer.first, layer.bias, layer.slope);
      this.finish(room.h[type], room.z[type], room.y[type], rows, layer, false);
    });
    for (const step of this.steps) {
      step.messages.forEach((layer, k) => {
        const { source, target } = this.relations[k], sums = room.sums[k], { target: a, source: b } = room.products[k];
        for (const [matrix, type] of [[sums.target, target], [sums.source, source]]) this.clear(matrix, nodes[type]);
        if (!edges[k]) return;
        this.multiply(a, room.h[target], nodes[target], layer.ofTarget, layer.bias);
        this.multiply(b, room.h[source], nodes[source], layer.ofSource, this.none);
        this.multiply(room.state, room.features[k], edges[k], layer.ofEdge, this.none);
        kernels.messages(
          room.state.at, room.target[k], room.source[k], edges[k], width, a.at, a.stride, b.at, b.stride,
          sums.target.at, sums.target.stride, sums.source.at, sums.source.stride, layer.slope,
        );
      });
      step.updates.forEach((layer, type) => {
        if (!layer) return;
        layer.sums.forEach(({ relation, end, weight }, place) => {
          const isLast = place === layer.sums.length - 1;
          this.multiply(room.z[type], room.sums[relation][end], nodes[type], weight, place ? null : layer.bias, isLast ? layer.slope : 1);
        });
        this.finish(room.h[type], room.z[type], room.y[type], nodes[type], layer, true);
      });
    }
    this.decoders.forEach((layer, type) => {
      if (!layer) return;
      this.multiply(room.z[type], room.h[type], nodes[type], layer.first, layer.bias, layer.slope);
      this.multiply(room.decoded[type], room.z[type], nodes[type], layer.last, layer.lastBias);
    });
  }

  clear(matrix, rows) {
    for (let r = 0; r < rows; r++) {
      const first = matrix.at / 4 + r * matrix.columns;
      this.heap.f32.fill(0, first, first + this.hidden);
    }
  }

  countEdges(edges) {
    const { room, heap } = this;
    edges.forEach((count, k) => {
      const sums = room.sums[k];
      for (const end of ["target", "source"]) {
        for (let r = 0; r < room.nodes[this.relations[k][end]]; r++) heap.f32[sums[end].at / 4 + r * sums[end].columns + this.hidden] = 0;
      }
      for (const [end, sign] of [["target", 1], ["source", -1]]) {
        const first = room[end][k] / 4, matrix = sums[end];
        for (let e = 0; e < count; e++) heap.f32[matrix.at / 4 + heap.i32[first + e] * matrix.columns + this.hidden] += sign;
      }
    });
  }
}
