// Shapes of single points. They distinguish the points without colour.

import { s } from "./dom.js";

/** Lines of a shape in a square of two units, the centre at 0. */
const CORNERS = {
  square: [[-0.85, -0.85], [0.85, -0.85], [0.85, 0.85], [-0.85, 0.85]],
  triangle: [[0, -1.1], [1.05, 0.8], [-1.05, 0.8]],
  diamond: [[0, -1.2], [1.1, 0], [0, 1.2], [-1.1, 0]],
};
/** Width of the line of a hollow shape and of a cross, as a share of the size. */
const LINE = 0.42;
/** Size of a shape in a legend (px). */
const KEY_SIZE = 4.2;

/** Draws a shape { shape, isHollow } of a size (px) at a place of a canvas, in one colour. */
export function drawShape(ctx, { shape, isHollow }, colour, x, y, size) {
  ctx.beginPath();
  if (shape === "cross") {
    for (const [from, to] of [[-1, 1], [1, -1]]) {
      ctx.moveTo(x + from * size, y - size);
      ctx.lineTo(x + to * size, y + size);
    }
  } else if (shape === "circle") {
    ctx.arc(x, y, size, 0, 2 * Math.PI);
  } else {
    for (const [right, down] of CORNERS[shape]) ctx.lineTo(x + right * size, y + down * size);
    ctx.closePath();
  }
  if (shape === "cross" || isHollow) {
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
  const lines = isHollow || shape === "cross";
  const look = { fill: lines ? "none" : "var(--key)", stroke: lines ? "var(--key)" : "none", "stroke-width": LINE * KEY_SIZE };
  const place = ([right, down]) => `${6 + right * KEY_SIZE} ${6 + down * KEY_SIZE}`;
  const cross = `M${place([-1, -1])} L${place([1, 1])} M${place([1, -1])} L${place([-1, 1])}`;
  const drawn = {
    circle: () => s("circle", { cx: 6, cy: 6, r: KEY_SIZE, ...look }),
    cross: () => s("path", { d: cross, ...look }),
  }[shape] ?? (() => s("path", { d: `M${CORNERS[shape].map(place).join(" L")} Z`, ...look }));
  return s("svg", { class: "key-shape", width: 12, height: 12, "aria-hidden": "true" }, drawn());
}
