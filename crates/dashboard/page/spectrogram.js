// The spectra of a channel over time: frequency upwards, density as colour. They are collected while the
// tab is open, because no service stores them.

import { t } from "./language.js";
import { Plot, power } from "./plot.js";
import { clock, densityUnit, number } from "./words.js";

/** Number of spectra kept of each channel: half an hour at one in ten seconds. */
const KEPT = 180;
/** Longest time that one spectrum stands for, in usual steps. A longer time is a gap. */
const MOST_STEPS = 2.5;
/** Usual step between two spectra before the second one (s). */
const STEP_S = 10;
/** Number of decades of density that the colours distinguish, below the highest one. */
const DECADES = 5;
/** Colours from low to high density. Their lightness grows, so that they also work without colour. */
const COLOURS = [[68, 1, 84], [71, 44, 122], [59, 81, 139], [44, 113, 142], [33, 144, 141], [39, 173, 129], [92, 200, 99], [170, 220, 50], [253, 231, 37]];
/** Number of steps between these colours. */
const SHADES = 128;

const shades = Array.from({ length: SHADES }, (_, index) => {
  const place = (index / (SHADES - 1)) * (COLOURS.length - 1);
  const [low, share] = [Math.floor(place), place % 1];
  const [from, to] = [COLOURS[low], COLOURS[Math.min(low + 1, COLOURS.length - 1)]];
  return `rgb(${from.map((one, channel) => Math.round(one + share * (to[channel] - one))).join()})`;
});

/** The latest spectra of all channels. */
export class SpectrumHistory {
  #channels = new Map();

  /** `fetch()` fetches the newest spectra. */
  constructor(structure, fetch) {
    Object.assign(this, { structure, fetch });
  }

  /** Adds a spectrum, unless it is known. An earlier time is a new run of measurement. */
  add(channel, time_s, frequencies, densities) {
    let of = this.#channels.get(channel);
    if (!of || time_s < of.spectra.at(-1).time_s || frequencies.length !== of.frequencies.length) {
      of = { frequencies, spectra: [] };
      this.#channels.set(channel, of);
    }
    if (of.spectra.at(-1)?.time_s === time_s) return;
    of.spectra.push({ time_s, densities: Float32Array.from(densities, (one) => one ?? NaN) });
    if (of.spectra.length > KEPT) of.spectra.shift();
  }

  /** Returns frequencies and spectra of a channel, or null without any. */
  columns(channel) {
    return this.#channels.get(channel) ?? null;
  }

  csv([channel]) {
    const { frequencies, spectra } = this.columns(channel) ?? { frequencies: [], spectra: [] };
    const rows = spectra.map(({ time_s, densities }) => [time_s, ...densities].join());
    return `data:text/csv,${encodeURIComponent([["time_s", ...frequencies.map((frequency) => `${frequency}_hz`)].join(), ...rows].join("\n"))}`;
  }
}

/**
 * The time that the spectrograms show: that of the other plots, but a live span starts no earlier than
 * the collected spectra, so that a few of them also fill the plot.
 */
class Collected {
  constructor(history, channel, span) {
    Object.assign(this, { history, channel, span });
  }

  get shown() {
    const { min, max } = this.span.shown;
    const spectra = this.history.columns(this.channel)?.spectra;
    if (!this.span.isLive || !spectra) return { min, max };
    const [first, last] = [spectra[0].time_s - STEP_S, spectra.at(-1).time_s];
    return { min: Math.min(Math.max(min, first), last - STEP_S), max: last };
  }

  get length_s() {
    return this.span.length_s;
  }

  fix(from_s, to_s) {
    this.span.fix(from_s, to_s);
  }

  live(length_s) {
    this.span.live(length_s);
  }
}

/** Creates the spectrogram of a channel. `modes()` returns the natural frequencies { name, frequency }. */
export function spectrogramPlot(sensor, history, span, modes) {
  const { channel } = sensor;
  const of = densityUnit(sensor.unit);
  const known = () => history.columns(channel);
  const plot = new Plot(
    {
      title: t("over-time", channel),
      file: `spectrogram-${channel}`,
      unit: t("frequency-hz"),
      names: [channel],
      hasLogarithmicY: true,
      rows: (columns) => {
        const { frequencies, spectra } = columns.get(channel);
        return [spectra.map(({ time_s }) => time_s), spectra.map(() => frequencies[0])];
      },
      series: () => [{ paths: () => null }],
      range: () => [known().frequencies[0], known().frequencies.at(-1)],
      paint: (u) => paint(u, known(), scale),
      marks: () => modes().map(({ name, frequency }) => ({ y: frequency, text: name, colour: "--card", plate: "--ink" })),
      readout: (_, at) => {
        const { frequencies, spectra } = known();
        const { densities } = spectra[Math.min(at, spectra.length - 1)];
        const highest = densities.reduce((best, one, index) => (one > (densities[best] || 0) ? index : best), 0);
        return t("highest-density-at-hz", number(frequencies[highest]), number(densities[highest]), of);
      },
      at: clock,
      isContinuous: true,
    },
    history,
    new Collected(history, channel, span),
  );
  const scale = plot.key("colours", of);
  return plot;
}

/** Draws the spectra, and writes the ends of the colours. */
function paint(u, { frequencies, spectra }, scale) {
  const { ctx, bbox } = u;
  const { min, max } = u.scales.x;
  const times = spectra.map(({ time_s }) => time_s);
  const steps = times.slice(1).map((time, index) => time - times[index]);
  const usual = steps.toSorted((a, b) => a - b)[steps.length >> 1] ?? STEP_S;
  const seen = spectra.filter(({ time_s }) => time_s >= min && time_s <= max + usual);
  const highest = seen.reduce((most, { densities }) => densities.reduce((most, one) => (one > most ? one : most), most), 0);
  if (!(highest > 0)) return;
  const top = Math.log10(highest);
  scale(power(10 ** Math.floor(top - DECADES)), power(10 ** Math.ceil(top)));
  const [low, high] = [Math.floor(top - DECADES), Math.ceil(top)];
  // Each frequency reaches half-way to its neighbours.
  const edges = [frequencies[0], ...frequencies.slice(1).map((frequency, index) => Math.sqrt(frequency * frequencies[index])), frequencies.at(-1)];
  const heights = edges.map((edge) => u.valToPos(edge, "y", true));
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  spectra.forEach(({ time_s, densities }, index) => {
    const length = index > 0 && steps[index - 1] <= MOST_STEPS * usual ? steps[index - 1] : usual;
    if (time_s < min || time_s - length > max) return;
    const [left, right] = [time_s - length, time_s].map((time) => Math.round(u.valToPos(time, "x", true)));
    densities.forEach((density, row) => {
      if (!(density > 0)) return;
      const share = Math.min(Math.max((Math.log10(density) - low) / (high - low), 0), 1);
      ctx.fillStyle = shades[Math.round(share * (SHADES - 1))];
      const [bottom, above] = [Math.round(heights[row]), Math.round(heights[row + 1])];
      ctx.fillRect(left, above, Math.max(right - left, 1), Math.max(bottom - above, 1));
    });
  });
  ctx.restore();
}
