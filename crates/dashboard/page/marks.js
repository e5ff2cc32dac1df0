// Places the labels of marks above a plot, each at its own line.

/** Most rows of words. */
const ROWS = 3;
/** Between a line and its word, and between two words (px). */
const GAP = 4;

/**
 * The marks { x, text } that are seen, with `at` (px from the left, where the line is), and row (the lowest is 0), from and to (px) of the word. Those
 * that come first have their words first; of one that has no room the row is -1, its line says when.
 */
export function flags(marks, { min, max }, width, measure) {
  if (!(max > min)) return [];
  const seen = marks
    .filter(({ x }) => x !== undefined && x >= min && x <= max)
    .map((mark) => ({ ...mark, at: ((mark.x - min) / (max - min)) * width, row: -1 }));
  const placed = [];
  for (const flag of seen) {
    const place = places(flag.at, measure(flag.text), width).find((one) => placed.every((other) => !isInTheWay(flag.at, one, other)));
    if (!place) continue;
    Object.assign(flag, place);
    placed.push(flag);
  }
  const used = [...new Set(placed.map(({ row }) => row))].sort((a, b) => a - b);
  for (const flag of placed) flag.row = used.indexOf(flag.row);
  return seen;
}

/** Where a word may stand: to the right of its line or else to the left, in the highest row first, so that others find room below. */
function places(at, wide, width) {
  const rows = Array.from({ length: ROWS }, (_, row) => ROWS - 1 - row);
  const [right, left] = [{ from: at + GAP, to: at + GAP + wide }, { from: at - GAP - wide, to: at - GAP }];
  return [right, left].filter(({ from, to }) => from >= 0 && to <= width).flatMap((ends) => rows.map((row) => ({ row, ...ends })));
}

/** Whether a word at this place lies on another one, or one of the two on the line that goes up to the other. */
function isInTheWay(at, place, other) {
  const isCrossed = (line, { from, to }) => line > from - GAP && line < to + GAP;
  if (place.row === other.row) return place.from < other.to + 2 * GAP && other.from < place.to + 2 * GAP;
  return place.row > other.row ? isCrossed(at, other) : isCrossed(other.at, place);
}
