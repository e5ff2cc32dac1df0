// Places the labels of marks above a plot, each at its own line.

/** Maximum number of rows of labels. */
const ROWS = 3;
/** Gap between a line and its label, and between two labels (px). */
const GAP = 4;

/**
 * Places the labels of marks.
 *
 * Returns the visible marks { x, text } with these fields:
 * - `at`: distance of the line from the left (px)
 * - `row`: row of the label, 0 for the lowest, or -1 if there is no room for the label
 * - `from`, `to`: ends of the label (px)
 *
 * Earlier marks have priority. A mark without a label still shows its time by its line. Marks with
 * the same text that are closer than their label share one label, which states their number.
 */
export function flags(marks, { min, max }, width, measure) {
  if (!(max > min)) return [];
  const seen = marks
    .filter(({ x }) => x !== undefined && x >= min && x <= max)
    .map((mark) => ({ ...mark, at: ((mark.x - min) / (max - min)) * width, row: -1 }));
  const placed = [];
  for (const flag of seen) {
    const same = placed.find((other) => other.text === flag.text && Math.abs(other.at - flag.at) < 2 * GAP + measure(flag.text));
    if (same) {
      same.count += 1;
      continue;
    }
    const place = places(flag.at, measure(flag.text), width).find((one) => placed.every((other) => !isInTheWay(flag.at, one, other)));
    if (!place) continue;
    Object.assign(flag, place, { count: 1 });
    placed.push(flag);
  }
  for (const flag of placed.filter(({ count }) => count > 1)) {
    const told = `${flag.text} ×${flag.count}`;
    const wider = places(flag.at, measure(told), width).find((one) => placed.every((other) => other === flag || !isInTheWay(flag.at, one, other)));
    if (wider) Object.assign(flag, wider, { text: told });
  }
  const used = [...new Set(placed.map(({ row }) => row))].sort((a, b) => a - b);
  for (const flag of placed) flag.row = used.indexOf(flag.row);
  return seen;
}

/**
 * Returns the possible places of a label: right of its line or else left, the highest row first, so
 * that lower rows stay free.
 */
function places(at, wide, width) {
  const rows = Array.from({ length: ROWS }, (_, row) => ROWS - 1 - row);
  const [right, left] = [{ from: at + GAP, to: at + GAP + wide }, { from: at - GAP - wide, to: at - GAP }];
  return [right, left].filter(({ from, to }) => from >= 0 && to <= width).flatMap((ends) => rows.map((row) => ({ row, ...ends })));
}

/**
 * Returns whether a label at this place overlaps another label, or either label overlaps the line
 * that leads to the other.
 */
function isInTheWay(at, place, other) {
  const isCrossed = (line, { from, to }) => line > from - GAP && line < to + GAP;
  if (place.row === other.row) return place.from < other.to + 2 * GAP && other.from < place.to + 2 * GAP;
  return place.row > other.row ? isCrossed(at, other) : isCrossed(other.at, place);
}
