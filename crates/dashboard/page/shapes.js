// Shapes of single points. They distinguish the points without colour.

import { s } from "./dom.js";

/** Lines of a shape in a square of two units, the centre at 0. */
const CORNERS = {
  square: [[-0.85, -0.85], [0.85, -0.85], [0.85, 0.85], [-0.85, 0.85]],
  triangle: [[0, -1.1], [1.05, 0.8], [-1.05, 0.8]],
  falling: [[0, 1.1], [1.05, -0.8], [-1.05, -0.8]],
  diamond: [[0, -1.2], [1.1, 0], [0, 1.2], [-1.1, 0]],
};
/** Width of the line of a hollow shape and of a ring, as a share of the size. */
const LINE = 0.42;
/** Size of a shape in a legend (px). */
const KEY_SIZE = 4.2;

/** Draws a shape { shape, isHollow } of a size (px) at a place of a canvas, in one colour. */
export function drawShape(ctx, { shape, isHollow }, colour, x, y, size) {
  ctx.beginPath();
  if (shape === "circle" || shape === "ring") {
    ctx.arc(x, y, size, 0, 2 * Math.PI);
  } else {
    for (const [right, down] of CORNERS[shape]) ctx.lineTo(x + right * size, y + down * size);
    ctx.closePath();
  }
  if (isHollow || shape === "ring") {
    [ctx.strokeStyle, ctx.lineWidth] = [colour, Math.max(1, LINE * size)];
    ctx.setLineDash([]);
    ctx.stroke();
  } else {
    ctx.fillStyle = colour;
    ctx.fill();
  }
}

/** Returns a shape for a legend, in the colour of the variable --key. */
export function shapeKey({ shape, isHollow }) {
  const look = { fill: isHollow ? "none" : "var(--key)", stroke: isHollow ? "var(--key)" : "none", "stroke-width": LINE * KEY_SIZE };
  const place = ([right, down]) => `${6 + right * KEY_SIZE} ${6 + down * KEY_SIZE}`;
  const circle = (r, of) => s("circle", { cx: 6, cy: 6, r, ...of });
  // A ring is drawn around the shape of a day.
  const ring = () => [circle(5, { fill: "none", stroke: "var(--key)", "stroke-width": 1.5 }), circle(2, { fill: "var(--key)" })];
  const drawn = {
    circle: () => [circle(KEY_SIZE, look)],
    ring,
  }[shape] ?? (() => [s("path", { d: `M${CORNERS[shape].map(place).join(" L")} Z`, ...look })]);
  return s("svg", { class: "key-shape", width: 12, height: 12, "aria-hidden": "true" }, ...drawn());
}
