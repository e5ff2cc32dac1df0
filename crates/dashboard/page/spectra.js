// The spectra of the samples of the last minute: fetched while their tab is open, and plotted.

import { t } from "./language.js";
import { Plot, css } from "./plot.js";
import { SpectrumHistory } from "./spectrogram.js";
import { densityUnit, number } from "./words.js";
import { Extent } from "./year.js";

/** Interval between two fetches (ms). Ingest publishes spectra every ten seconds. */
const FETCH_EVERY_MS = 10_000;
/** Number of decades below the highest density that a plot shows at most. */
const MOST_DECADES = 8;

/** The shown frequencies. They stay within those of the spectra, because a logarithm needs that. */
class Band extends Extent {
  fix(from, to) {
    super.fix(Math.max(from, this.all[0]), Math.min(to, this.all[1]));
  }
}

/** The newest spectra of all channels of a structure. */
export class Spectra {
  #channels = new Map();
  #asked = null;
  #askedAt = 0;
  band = new Band();

  constructor(structure) {
    this.structure = structure;
    /** The spectra since the tab was opened. */
    this.history = new SpectrumHistory(structure, () => this.fetch());
  }

  /** Names of the channels with a spectrum. */
  get channels() {
    return [...this.#channels.keys()];
  }

  /** Returns frequencies (Hz) and densities of a channel, or null before they have arrived. */
  columns(channel) {
    return this.#channels.get(channel)?.columns ?? null;
  }

  /** Returns the windows of a channel in words. */
  words(channel) {
    const { windows, window_s: length } = this.#channels.get(channel);
    return t("mean-of-of-s", windows, windows === 1 ? t("window") : t("windows"), number(length));
  }

  /** Returns the address of the spectrum of a channel as CSV. */
  csv([channel]) {
    const [frequencies, densities] = this.columns(channel) ?? [[], []];
    const rows = frequencies.map((frequency, index) => `${frequency},${densities[index] ?? ""}`);
    return `data:text/csv,${encodeURIComponent(["frequency_hz,density", ...rows].join("\n"))}`;
  }

  /** Fetches all spectra, once for all plots. Returns whether they have arrived. */
  fetch() {
    if (this.#asked === null || performance.now() - this.#askedAt > FETCH_EVERY_MS) {
      this.#askedAt = performance.now();
      this.#asked = this.#fetch().catch(() => false);
    }
    return this.#asked;
  }

  async #fetch() {
    const response = await fetch(`/api/structures/${encodeURIComponent(this.structure)}/spectra`);
    if (!response.ok) return false;
    const { nodes } = await response.json();
    this.#channels.clear();
    for (const { frequencies_hz: frequencies, window_s, time_ns, channels } of nodes) {
      this.band.all = [frequencies[0], frequencies.at(-1)];
      for (const { channel, windows, density } of channels) {
        if (windows === 0) continue;
        const densities = density.map((one) => (one > 0 ? one : null));
        this.#channels.set(channel, { windows, window_s, columns: [frequencies, densities] });
        this.history.add(channel, time_ns / 1e9, frequencies, densities);
      }
    }
    return true;
  }
}

/**
 * Creates the plot of the spectrum of a channel. `shared(range)` returns the shown range for the
 * range that the channel needs. `modes()` returns the natural frequencies { name, frequency }.
 */
export function spectrumPlot(sensor, spectra, shared, modes) {
  const of = densityUnit(sensor.unit);
  return new Plot(
    {
      title: sensor.channel,
      file: `spectrum-${sensor.channel}`,
      unit: of,
      names: [sensor.channel],
      isLogarithmic: true,
      across: () => t("frequency-hz"),
      rows: (columns) => columns.get(sensor.channel),
      series: () => [{ stroke: () => css("--line-1"), width: 1.5 }],
      range: (_, least, largest) => {
        if (!(largest > 0)) return shared(null) ?? [1e-6, 1];
        const high = 10 ** Math.ceil(Math.log10(largest));
        return shared([Math.max(10 ** Math.floor(Math.log10(least)), high / 10 ** MOST_DECADES), high]);
      },
      marks: () => modes().map(({ name, frequency }) => ({ x: frequency, text: name, colour: "--line-2" })),
      // Without a crosshair, the reading is that of the highest density.
      newest: ([, densities]) => densities.reduce((highest, density, row) => (density > (densities[highest] ?? 0) ? row : highest), 0),
      readout: (data, at) => `${number(data[0][at])} Hz · ${number(data[1][at])} ${of} · ${spectra.words(sensor.channel)}`,
    },
    spectra,
    spectra.band,
  );
}
