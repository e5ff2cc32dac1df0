// The plots of a structure.

import { t } from "./language.js";
import { COLOURS, Plot, css, look, padded } from "./plot.js";
import { AXES, STATES, distanceWords, isLasting, isOpen, judgedEstimate, number, openWords, percent, probability, ratio, unit } from "./words.js";

/** Half-widths of the 50, 95 and 99.7 % intervals of a Gaussian, in standard deviations. */
const HALF_WIDTHS = [
  ["99.7 %", 2.9677],
  ["95 %", 1.96],
  ["50 %", 0.6745],
];

/** States of alerts in the order of priority of their labels. */
const WORDS_FIRST = ["raised", "unconfirmed", "acknowledged", "cleared", "pending", "softening-in-motion", "undecided", "learning", "normal"];

const line = (index, more) => ({ stroke: () => css(look(index).colour), width: 2, dash: look(index).dash, ...more });
const edge = { stroke: "transparent", width: 0 };

/** Returns mean and bands: time, mean, then low and high of each band. */
function meanWithBands(columns) {
  const [times, mean, std] = columns;
  const ends = HALF_WIDTHS.flatMap(([, half]) => [mean.map((one, index) => one - half * std[index]), mean.map((one, index) => one + half * std[index])]);
  return [times, mean, ...ends];
}

const bandSeries = () => [line(0), edge, edge, edge, edge, edge, edge];
const bandFills = () => [
  { series: [3, 2], fill: css("--band-997") },
  { series: [5, 4], fill: css("--band-95") },
  { series: [7, 6], fill: css("--band-50") },
];

/**
 * Creates the plot of a parameter: estimate with bands, threshold, and marks of its alerts. Stiffness
 * parameters share a `scale`, if there is one.
 */
export function parameterPlot(parameter, standing, points, span, scale, id) {
  const [name, lossName] = [`parameter/${parameter.name}`, `loss/${parameter.name}`];
  /** The loss under the alert rule. Undefined without a rule, and while the reference is learnt. */
  const known = () => standing()?.losses[parameter.name];
  const threshold = () => known() && (1 - known().rule_loss) * known().reference;
  const changes = () => (standing()?.changes ?? []).filter((change) => change.parameter === parameter.name && !isLasting(change));
  const marks = () => {
    const loss = known();
    const bound = loss && parameter.stiffness ? [{ y: threshold(), text: t("threshold-lost", percent(loss.rule_loss, 0)), colour: "--alarm", isBelow: true }] : [];
    const told = changes().toSorted((a, b) => WORDS_FIRST.indexOf(a.state) - WORDS_FIRST.indexOf(b.state));
    return [...bound, ...told.map((change) => ({ x: change.changed_ns / 1e9, text: `${STATES[change.state].sign} ${STATES[change.state].word}`, colour: `--${STATES[change.state].level}` }))];
  };
  return new Plot(
    {
      title: parameter.name,
      file: `parameter-${parameter.name}`,
      id,
      unit: AXES.ratio,
      names: [name, lossName],
      rows: (columns) => {
        const estimates = columns.get(name) ?? [[], [], []];
        // Behind the bands: loss, its interval, and its probability.
        return [...meanWithBands(estimates), ...[1, 2, 3, 4].map((column) => latest(columns.get(lossName), column, estimates[0]))];
      },
      series: () => [...bandSeries(), ...[1, 2, 3, 4].map(() => ({ show: false }))],
      bands: bandFills,
      // Keeps the threshold in view, and prevents the wide bands of the first seconds from
      // flattening the rest.
      range: (u) => {
        const { min, max } = span.shown;
        const shown = (range) => (scale && parameter.stiffness ? scale.of(parameter.name, range) : range);
        const seen = (column) => column.filter((value, row) => value !== null && u.data[0][row] >= min && u.data[0][row] <= max);
        const ends = [quantile(seen(u.data[2]), 0.05), quantile(seen(u.data[3]), 0.95), ...seen(u.data[1]).slice(-1), parameter.stiffness ? threshold() : null];
        const finite = ends.filter((end) => end != null);
        if (finite.length === 0) return shown([0.5, 1.5]);
        const [low, high] = [Math.min(...finite), Math.max(...finite)];
        const room = Math.max((high - low) * 0.1, 0.005);
        return shown([low - room, high + room]);
      },
      readout: (data, at) => {
        if (data[1][at] === null) return t("no-data");
        const loss = known();
        const [lost, least, most, chance] = [8, 9, 10, 11].map((column) => data[column][at]);
        const told = probability(chance, loss?.rule_credibility);
        const alert = standing()?.alerts.find((alert) => alert.parameter === parameter.name);
        const isJudged = loss && parameter.stiffness && chance !== null;
        const asked = isJudged ? t("p-loss", percent(loss.rule_loss, 0), openWords(alert, told)) : "";
        // Without a finding, the interval of the filter would contradict the probability beside it.
        const { mean, low, high } = isJudged && isOpen(alert) ? judgedEstimate({ loss: lost, low: least, high: most }, loss.reference) : { mean: data[1][at], low: data[4][at], high: data[5][at] };
        return t("95-per-cent-to", ratio(mean), ratio(low), ratio(high), asked);
      },
      marks,
    },
    points,
    span,
  );
}

/** Returns, for each time, the last value of a column up to that time. Null before the first. */
function latest(columns, column, times) {
  let row = -1;
  return times.map((time) => {
    while (columns && row + 1 < columns[0].length && columns[0][row + 1] <= time) row += 1;
    return row < 0 ? null : columns[column][row];
  });
}

function quantile(values, share) {
  if (values.length === 0) return null;
  return [...values].sort((a, b) => a - b)[Math.round(share * (values.length - 1))];
}

/** Creates the plot of a noise level: the standard deviation with bands, or a ratio without a unit. */
export function noisePlot(level, points, span) {
  const name = `noise/${level.name}`;
  const root = (column) => (level.unit ? column.map((variance) => (variance === null ? null : Math.sqrt(Math.max(variance, 0)))) : column);
  return new Plot(
    {
      title: t("noise-of", level.name),
      file: `noise-${level.name}`,
      unit: level.unit ? t("standard-deviation-of-a-sample", unit(level.unit)) : AXES.damping,
      names: [name],
      rows: (columns) => {
        const [times, ...values] = meanWithBands(columns.get(name));
        return [times, ...values.map(root)];
      },
      series: bandSeries,
      bands: bandFills,
      readout: (data, at) => (data[1][at] === null ? t("no-data") : level.unit ? t("standard-deviation-of-one-sample", number(data[1][at]), unit(level.unit)) : number(data[1][at])),
    },
    points,
    span,
  );
}

/**
 * Creates the plot of a channel's innovations, between the minimum and maximum of each interval.
 * `shared(range)` returns the shown range for the range that the channel needs.
 */
export function innovationPlot(sensor, points, span, shared) {
  const name = `innovation/${sensor.channel}`;
  return new Plot(
    {
      title: t("innovations-of", sensor.channel),
      file: `innovation-${sensor.channel}`,
      unit: unit(sensor.unit),
      names: [name],
      rows: (columns) => columns.get(name),
      series: () => [line(1, { width: 1, dash: [] }), line(1, { width: 1, dash: [] })],
      bands: () => [{ series: [2, 1], fill: css("--band-95") }],
      range: (u, least, largest) => shared(largest === null ? null : padded(u, least, largest)) ?? [0, 1],
      readout: (data, at) => (data[1][at] === null ? t("no-sample-used") : t("range-in-unit", number(data[1][at]), number(data[2][at]), unit(sensor.unit))),
      marks: () => [{ y: 0, text: "" }],
    },
    points,
    span,
  );
}

/**
 * Creates the plot of the samples of a channel, between the minimum and maximum of each bucket.
 * `shared(range)` returns the shown range for the range that the channel needs.
 */
export function waveformPlot(sensor, points, span, shared) {
  const name = `waveform/${sensor.channel}`;
  return new Plot(
    {
      title: sensor.channel,
      file: `waveform-${sensor.channel}`,
      unit: unit(sensor.unit),
      names: [name],
      rows: (columns) => columns.get(name),
      series: () => [line(0, { width: 1, dash: [] }), line(0, { width: 1, dash: [] })],
      // In one colour, so that parts with many points do not look different from parts with few.
      bands: () => [{ series: [2, 1], fill: css("--line-1") }],
      range: (u, least, largest) => shared(largest === null ? null : padded(u, least, largest)) ?? [0, 1],
      readout: (data, at) => (data[1][at] === null ? t("no-sample") : t("range-in-unit", number(data[1][at]), number(data[2][at]), unit(sensor.unit))),
    },
    points,
    span,
  );
}

/** Creates the plot of the agreement between model and data. */
export function consistencyPlot(points, span) {
  return new Plot(
    {
      title: t("normalised-innovation-squared"),
      file: "consistency",
      unit: AXES.consistency,
      names: ["consistency/all"],
      rows: (columns) => columns.get("consistency/all"),
      series: () => [line(2, { dash: [], width: 1.5 })],
      range: (u, least, largest) => [0, Math.max(2, (largest ?? 1) * 1.1)],
      readout: (data, at) => t("per-channel-1-when-model-and-noise", number(data[1][at])),
      marks: () => [{ y: 1, text: t("expected") }],
    },
    points,
    span,
  );
}

/** Creates the plot of a condition, such as a temperature. Each value is a point. */
export function conditionPlot(condition, points, span) {
  const name = `condition/${condition.name}`;
  const of = unit(condition.unit);
  return new Plot(
    {
      title: condition.name,
      file: `condition-${condition.name}`,
      unit: of,
      names: [name],
      rows: (columns) => columns.get(name) ?? [[], []],
      series: () => [line(4, { dash: [], width: 1.5, points: { show: true, size: 5 } })],
      readout: (data, at) => (data[1][at] === null ? t("no-data") : `${number(data[1][at])} ${of}`),
    },
    points,
    span,
  );
}

/** Creates the plot of the natural frequency of a mode, with bands. Each epoch is a point. */
export function modePlot(mode, points, span) {
  const name = `mode/${mode}`;
  return new Plot(
    {
      title: mode,
      file: `mode-${mode}`,
      unit: "Hz",
      names: [name],
      rows: (columns) => meanWithBands(columns.get(name) ?? [[], [], []]),
      series: () => [line(0, { points: { show: true, size: 5 } }), edge, edge, edge, edge, edge, edge],
      bands: bandFills,
      readout: (data, at) => (data[1][at] === null ? t("no-data") : t("hz-95-per-cent-to-hz", number(data[1][at]), number(data[4][at]), number(data[5][at]))),
    },
    points,
    span,
  );
}

/** Creates the plot of a channel's outlier screening. */
export function outlierPlot(channel, points, span) {
  const name = `outlier/${channel}`;
  return new Plot(
    {
      title: t("outliers-of", channel),
      file: `outlier-${channel}`,
      unit: t("rejected-per-cent"),
      names: [name],
      rows: (columns) => [columns.get(name)[0], columns.get(name)[1].map((share) => 100 * share), columns.get(name)[2]],
      series: () => [line(3, { dash: [], fill: () => css("--band-997") }), { show: false }],
      range: (u, least, largest) => [0, Math.max(1, (largest ?? 0) * 1.1)],
      readout: (data, at) => t("per-cent-of-the-recent-samples-rejected", number(data[1][at]), number(data[2][at])),
    },
    points,
    span,
  );
}

/** Creates the plot of the plausibilities of the model classes, stacked to 1. */
export function classPlot(classes, points, span) {
  const names = classes.map((name) => `class/${name}`);
  return new Plot(
    {
      title: t("plausibility-of-the-model-classes"),
      file: "classes",
      legend: classes.map((name, index) => ({ name, colour: `${COLOURS[index % COLOURS.length]}-fill` })),
      unit: AXES.plausibility,
      names,
      rows: (columns) => stacked(names.map((name) => columns.get(name))),
      // Drawn from the top, so that the first class is in front.
      series: () => names.map((_, index) => line(index, { width: 1, fill: () => css(`${COLOURS[index % COLOURS.length]}-fill`) })).toReversed(),
      range: () => [0, 1],
      readout: (data, at) => {
        const sums = data.slice(1).toReversed().map((column) => column[at]);
        return classes.map((name, index) => `${name} ${percent((sums[index] ?? 0) - (index > 0 ? (sums[index - 1] ?? 0) : 0), 0)}`).join(" · ");
      },
    },
    points,
    span,
  );
}

/**
 * Returns cumulative sums over the classes, the largest first. A class without a value at a time
 * counts as 0.
 */
function stacked(series) {
  const known = series.map((columns) => new Map(columns ? columns[0].map((time, row) => [time, columns[1][row]]) : []));
  const times = [...new Set(known.flatMap((one) => [...one.keys()]))].sort((a, b) => a - b);
  let sum = times.map(() => 0);
  const sums = known.map((one) => (sum = sum.map((value, row) => value + (one.get(times[row]) ?? 0))));
  return [times, ...sums.toReversed()];
}

/** Creates the plot of the distances of the distributed nodes, each from all others. */
export function nodePlot(nodes, points, span) {
  const names = nodes.map((name) => `node/${name}`);
  return new Plot(
    {
      title: t("nodes-distance-from-the-others"),
      file: "nodes",
      legend: nodes.map((name, index) => ({ name, ...look(index) })),
      unit: AXES.distance,
      names,
      rows: (columns) => aligned(names.map((name) => columns.get(name))),
      // The limit is constant. Its mark is the line, and its series only keeps it in view.
      series: () => [...names.map((_, index) => line(index, { width: 1.5 })), edge],
      marks: () => {
        const limits = names.map((name) => points.columns(name)?.[2].findLast((limit) => limit != null));
        return limits.filter((limit) => limit !== undefined).slice(0, 1).map((y) => ({ y, text: t("limit"), colour: "--alarm" }));
      },
      readout: (data, at) => nodes.map((name, index) => [name, data[index + 1][at]]).filter(([, distance]) => distance !== null).sort((a, b) => b[1] - a[1]).slice(0, 4).map(([name, distance]) => `${name} ${distanceWords(distance)}`).join(" · "),
    },
    points,
    span,
  );
}

/** Returns the columns on a common time axis: one distance per node, then the limit. */
function aligned(series) {
  const rows = new Map();
  series.forEach((columns, node) => {
    columns?.[0].forEach((time, row) => {
      if (!rows.has(time)) rows.set(time, { distances: series.map(() => null), limit: null });
      rows.get(time).distances[node] = columns[1][row];
      rows.get(time).limit = columns[2][row] ?? rows.get(time).limit;
    });
  });
  const times = [...rows.keys()].sort((a, b) => a - b);
  const column = (of) => times.map((time) => of(rows.get(time)));
  return [times, ...series.map((_, node) => column((row) => row.distances[node])), column((row) => row.limit)];
}
