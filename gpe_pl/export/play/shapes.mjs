// Walls and obstacles in 2D: signed distances, boundary nodes on surfaces, and containment, as in ``geometry.shapes`` and ``rollout.containment``.

const ON_SURFACE = 1e-6, NUM_PASSES = 4, FACING = -0.9;

const distances = {
  wall: (s, x, y) => (s.normal[0] ? x * s.normal[0] : y * s.normal[1]) - s.offset,
  sphere: (s, x, y) => Math.hypot(x - s.center[0], y - s.center[1]) - s.radius,
  bowl: (s, x, y) => s.radius - Math.hypot(x - s.center[0], y - s.center[1]),
  box(s, x, y) {
    const qx = Math.abs(x - (s.low[0] + s.high[0]) / 2) - (s.high[0] - s.low[0]) / 2;
    const qy = Math.abs(y - (s.low[1] + s.high[1]) / 2) - (s.high[1] - s.low[1]) / 2;
    return Math.hypot(Math.max(qx, 0), Math.max(qy, 0)) + Math.min(Math.max(qx, qy), 0);
  },
  polygon(s, x, y) {
    let square = Infinity, inside = false;
    s.vertices.forEach(([ax, ay], k) => {
      const [bx, by] = s.vertices[(k + 1) % s.vertices.length], ex = bx - ax, ey = by - ay, wx = x - ax, wy = y - ay;
      const t = Math.min(Math.max((wx * ex + wy * ey) / (ex * ex + ey * ey), 0), 1);
      square = Math.min(square, (wx - t * ex) ** 2 + (wy - t * ey) ** 2);
      if (ay > y !== by > y && wx < (ex * wy) / (ey || 1)) inside = !inside;
    });
    return inside ? -Math.sqrt(square) : Math.sqrt(square);
  },
};

export const distanceTo = (shape, x, y) => distances[shape.kind](shape, x, y);

export const nearest = (shapes, x, y) => shapes.reduce((least, shape) => Math.min(least, distanceTo(shape, x, y)), Infinity);

function normalOf(shape, x, y, step) {
  if (shape.kind === "wall") return shape.normal;
  const dx = distanceTo(shape, x + step, y) - distanceTo(shape, x - step, y);
  const dy = distanceTo(shape, x, y + step) - distanceTo(shape, x, y - step);
  const length = Math.hypot(dx, dy) || 1;
  return [dx / length, dy / length];
}

const sides = {
  wall: (s) => [0, s.high[0] - s.low[0], s.high[1] - s.low[1]],
  sphere: (s) => [2 * s.radius],
  bowl: (s) => [2 * s.radius],
  box: (s) => [s.high[0] - s.low[0], s.high[1] - s.low[1]],
  polygon: (s) => [0, 1].map((a) => Math.max(...s.vertices.map((v) => v[a])) - Math.min(...s.vertices.map((v) => v[a]))),
};

const surfaceTolerance = (shapes) => ON_SURFACE * Math.max(0, ...shapes.flatMap((shape) => sides[shape.kind](shape)));

// --- boundary nodes ------------------------------------------------------------------------------------------------------------------------------

/** Points from one end to the other, the last excluded. */
function segment([ax, ay], [bx, by], spacing) {
  const count = Math.max(1, Math.ceil(Math.hypot(bx - ax, by - ay) / spacing - 1e-9));
  return [...Array(count).keys()].map((k) => [ax + ((bx - ax) * k) / count, ay + ((by - ay) * k) / count]);
}

function circle({ center, radius }, spacing, sign) {
  const count = Math.max(6, Math.ceil((2 * Math.PI * radius) / spacing));
  return [...Array(count).keys()].map((k) => {
    const angle = (2 * Math.PI * k) / count, n = [Math.cos(angle), Math.sin(angle)];
    return { pos: [center[0] + radius * n[0], center[1] + radius * n[1]], normal: [sign * n[0], sign * n[1]] };
  });
}

function polygonNodes(vertices, spacing) {
  return vertices.flatMap((a, k) => {
    const b = vertices[(k + 1) % vertices.length], length = Math.hypot(b[0] - a[0], b[1] - a[1]);
    const normal = [(b[1] - a[1]) / length, -(b[0] - a[0]) / length];
    return segment(a, b, spacing).map((pos) => ({ pos, normal }));
  });
}

const samples = {
  wall(s, spacing) {
    const axis = s.normal[0] ? 0 : 1, other = 1 - axis, length = s.high[other] - s.low[other];
    const count = Math.max(2, Math.ceil(length / spacing - 1e-9) + 1);
    return [...Array(count).keys()].map((k) => {
      const pos = [0, 0];
      pos[axis] = s.offset * s.normal[axis];
      pos[other] = s.low[other] + (length * k) / (count - 1);
      return { pos, normal: s.normal };
    });
  },
  sphere: (s, spacing) => circle(s, spacing, 1),
  bowl: (s, spacing) => circle(s, spacing, -1),
  box(s, spacing) {
    const nodes = polygonNodes([s.low, [s.high[0], s.low[1]], s.high, [s.low[0], s.high[1]]], spacing), half = Math.SQRT1_2;
    const middle = [(s.low[0] + s.high[0]) / 2, (s.low[1] + s.high[1]) / 2];
    const isCorner = ([x, y]) => (x === s.low[0] || x === s.high[0]) && (y === s.low[1] || y === s.high[1]);
    return nodes.map(({ pos, normal }) => ({ pos, normal: isCorner(pos) ? pos.map((x, a) => (x < middle[a] ? -half : half)) : normal }));
  },
  polygon: (s, spacing) => polygonNodes(s.vertices, spacing),
};

/** Return the boundary nodes of shapes, about ``spacing`` apart, without those inside another shape. */
export function boundaryOf(shapes, spacing) {
  const rounding = 1e-3 * surfaceTolerance(shapes);
  const nodes = shapes.flatMap((shape) =>
    samples[shape.kind](shape, spacing)
      .filter(({ pos: [x, y] }) => shapes.every((other) => other === shape || distanceTo(other, x, y) > -rounding))
      .map(({ pos, normal }) => ({ pos, normal, friction: shape.friction, restitution: shape.restitution })));
  return {
    count: nodes.length,
    pos: Float64Array.from(nodes.flatMap((n) => n.pos)),
    normal: Float64Array.from(nodes.flatMap((n) => n.normal)),
    friction: Float64Array.from(nodes, (n) => n.friction),
    restitution: Float64Array.from(nodes, (n) => n.restitution),
  };
}

// --- containment ---------------------------------------------------------------------------------------------------------------------------------

/** Return whether a point is on the surfaces of two shapes that face each other, as under a box that stands on the floor. */
function isBetween(shapes, x, y, tolerance) {
  const normals = shapes.filter((s) => Math.abs(distanceTo(s, x, y)) <= tolerance).map((s) => normalOf(s, x, y, tolerance));
  return normals.some((a, k) => normals.slice(0, k).some((b) => a[0] * b[0] + a[1] * b[1] < FACING));
}

/** Move nodes inside a wall or obstacle back to its surface and change their velocities to match. Return their number. */
export function contain(shapes, state, dt) {
  const tolerance = surfaceTolerance(shapes), { pos, vel } = state;
  let corrected = 0;
  for (let n = 0; n < state.count; n++) {
    const distance = nearest(shapes, pos[2 * n], pos[2 * n + 1]);
    if (!(distance < -tolerance || (distance <= tolerance && isBetween(shapes, pos[2 * n], pos[2 * n + 1], tolerance)))) continue;
    corrected++;
    let x = pos[2 * n], y = pos[2 * n + 1];
    for (let pass = 0; pass < NUM_PASSES && nearest(shapes, x, y) < 0; pass++) {
      for (const shape of shapes) {
        const depth = -distanceTo(shape, x, y);
        if (depth > 0) {
          const normal = normalOf(shape, x, y, tolerance);
          x += depth * normal[0];
          y += depth * normal[1];
        }
      }
    }
    if (nearest(shapes, x, y) < -tolerance || isBetween(shapes, x, y, tolerance)) [x, y] = [0, 1].map((a) => pos[2 * n + a] - vel[2 * n + a] * dt);
    [x, y].forEach((value, a) => {
      vel[2 * n + a] += (value - pos[2 * n + a]) / dt;
      pos[2 * n + a] = value;
    });
  }
  return corrected;
}
