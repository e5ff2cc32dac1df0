//! The modes of a recording as text, JSON and CSV.

use super::analysis::{Absence, Analysis, absent};
use super::frames::{Frames, listed};
use super::stiffness;
use crate::commands::counted;
use serde_json::{Value, json};
use spandrel_bus::{Event, ModeDisplay};
use spandrel_modal::{ChannelUse, ModeSummary, Source};
use spandrel_modes::ModesOutput;
use std::fmt::Write as _;
use std::path::Path;

/// Ratio of the scatter of frequencies to their stated deviation above which recordings differ.
/// With two epochs, chance exceeds it in 0.3 % of the modes, and with more epochs more rarely.
const DIFFERS: f64 = 3.0;

/// Recordings of the same channels, and the path by which the user has named them.
#[derive(Debug, Clone, Copy)]
pub struct Recordings<'a> {
    /// The path of a file or folder.
    pub path: &'a Path,
    /// The recordings, at least one.
    pub all: &'a [Frames],
    /// The first one.
    pub first: &'a Frames,
}

impl Recordings<'_> {
    /// Returns the length of all recordings (s).
    fn length_s(&self) -> f64 {
        self.all.iter().map(Frames::length_s).sum()
    }

    /// Returns the recordings without an epoch.
    fn unused(&self, analysis: &Analysis) -> Vec<&Frames> {
        let numbered = self.all.iter().enumerate();
        numbered
            .filter(|(position, _)| !analysis.recording.contains(position))
            .map(|(_, frames)| frames)
            .collect()
    }

    pub(super) fn name(&self, position: usize) -> String {
        let path = self.all.get(position).map(|frames| frames.path.display());
        path.map(|path| path.to_string()).unwrap_or_default()
    }
}

/// Returns the table for people.
pub fn text(records: Recordings<'_>, analysis: &Analysis) -> String {
    let frames = records.first;
    let epoch_s = analysis
        .record
        .epochs()
        .first()
        .map_or(0.0, |epoch| epoch.length_s);
    let mut text = format!(
        "{}: {}{} channels at {} Hz, {:.1} s, {} of {epoch_s:.1} s\n",
        records.path.display(),
        match records.all.len() {
            1 => String::new(),
            several => format!("{several} recordings, "),
        },
        frames.names.len(),
        frames.rate_hz,
        records.length_s(),
        counted(analysis.epochs.len(), "epoch", "epochs"),
    );
    for unused in records.unused(analysis) {
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "no epoch in {}, which is {:.1} s long",
            unused.path.display(),
            unused.length_s()
        );
    }
    if !frames.left_out.is_empty() {
        let _ = writeln!(text, "left out: {}", listed(&frames.left_out));
    }
    for Absence {
        channel,
        epochs,
        first,
    } in absent(&frames.names, analysis)
    {
        let reason = match first {
            ChannelUse::Used => "used".to_owned(),
            ChannelUse::Constant => "constant".to_owned(),
            ChannelUse::Dead => "no sample".to_owned(),
            ChannelUse::Incomplete { missing } => {
                format!("{:.0} % of its samples are missing", 100.0 * missing)
            }
        };
        let of = counted(epochs, "epoch", "epochs");
        let _ = writeln!(text, "left out of {of}: {channel} ({reason})");
    }
    text += &mode_rows(analysis);
    if !analysis.uncertain.is_empty() {
        let modes = counted(analysis.uncertain.len(), "mode", "modes");
        let at = analysis.uncertain.iter();
        let at: Vec<String> = at.map(|mode| format!("{:.2}", mode.frequency_hz)).collect();
        let _ = writeln!(
            text,
            "not listed: {modes} whose damping ratio is less than twice its standard deviation, at \
             {} Hz",
            at.join(", ")
        );
    }
    text + &differing_text(records, analysis)
        + &declared_text(analysis)
        + &stiffness::text(analysis)
}

/// Returns a heading, and one row for each mode or machine.
fn mode_rows(analysis: &Analysis) -> String {
    let mut text =
        "\nmode  frequency Hz       ±  scatter  damping %      ±  epochs  complexity\n".to_owned();
    let mut number = 0;
    for mode in &analysis.modes {
        let name = match mode.source {
            Source::Mode => {
                number += 1;
                number.to_string()
            }
            Source::Machine => "–".to_owned(),
        };
        let scatter = mode
            .frequency_scatter_hz
            .map_or_else(|| "–".to_owned(), |scatter| format!("{scatter:.4}"));
        let _ = write!(
            text,
            "{name:>4}  {:>12.4}  {:>6.4}  {scatter:>7}  {:>9.2}  {:>5.2}  {:>4.0} %  {:>10.3}",
            mode.frequency_hz,
            mode.frequency_std_hz,
            100.0 * mode.damping,
            100.0 * mode.damping_std,
            100.0 * mode.epochs,
            1.0 - mode.collinearity,
        );
        text += match mode.source {
            Source::Mode => "\n",
            Source::Machine => "  a machine, not a mode: no damping, constant amplitude\n",
        };
    }
    text
}

/// Names the modes whose frequency differs between recordings by more than chance.
fn differing_text(records: Recordings<'_>, analysis: &Analysis) -> String {
    let modes = analysis.modes.iter();
    let numbered = modes.filter(|mode| mode.source == Source::Mode).zip(1..);
    let differs = |mode: &ModeSummary| {
        let limit_hz = DIFFERS * mode.frequency_std_hz;
        mode.frequency_scatter_hz
            .is_some_and(|scatter_hz| scatter_hz > limit_hz)
    };
    let differing: Vec<String> = numbered
        .filter(|(mode, _)| differs(mode))
        .map(|(_, number): (_, u32)| number.to_string())
        .collect();
    if records.all.len() == 1 || differing.is_empty() {
        return String::new();
    }
    format!(
        "the recordings differ: scatter above {DIFFERS} times the stated deviation in mode {}; \
         --csv writes the frequencies of each recording\n",
        differing.join(", ")
    )
}

fn displays(analysis: &Analysis) -> impl Iterator<Item = &ModeDisplay> {
    analysis.declared.iter().filter_map(|output| match output {
        ModesOutput::Mode(display) => Some(display.as_ref()),
        ModesOutput::Event(_) | ModesOutput::Parameter(_) => None,
    })
}

fn events(analysis: &Analysis) -> impl Iterator<Item = &Event> {
    analysis.declared.iter().filter_map(|output| match output {
        ModesOutput::Mode(_) | ModesOutput::Parameter(_) => None,
        ModesOutput::Event(event) => Some(event),
    })
}

/// Returns the declared modes after the last epoch, as the service `modes` would publish them.
fn declared_text(analysis: &Analysis) -> String {
    let last = displays(analysis).map(|display| display.epochs).max();
    let Some(last) = last else {
        return String::new();
    };
    let of_last: Vec<&ModeDisplay> = displays(analysis)
        .filter(|display| display.epochs == last)
        .collect();
    let names = of_last.iter().map(|display| display.mode.as_str().len());
    let width = names.max().unwrap_or(0).max("declared mode".len());
    let mut text = format!(
        "\n{:width$}  frequency Hz       ±  damping %      ±  present  state after epoch {last}\n",
        "declared mode"
    );
    for display in of_last {
        let numbers = match &display.estimate {
            Some(estimate) => format!(
                "{:>12.4}  {:>6.4}  {:>9.2}  {:>5.2}",
                estimate.frequency_hz,
                estimate.frequency_std_hz,
                100.0 * estimate.damping,
                100.0 * estimate.damping_std,
            ),
            None => format!("{:>12}  {:>6}  {:>9}  {:>5}", "–", "–", "–", "–"),
        };
        let partner = display.partner.iter().map(|name| format!(" with {name}"));
        let machine = display.machine.then(|| ", a machine runs here".to_owned());
        let _ = writeln!(
            text,
            "{:width$}  {numbers}  {:>5.0} %  {}{}",
            display.mode.as_str(),
            100.0 * display.presence,
            display.state.as_str(),
            partner.chain(machine).collect::<String>(),
        );
    }
    text
}

/// Returns the modes as one JSON object.
pub fn json(records: Recordings<'_>, analysis: &Analysis) -> String {
    let frames = records.first;
    let modes: Vec<Value> = analysis
        .modes
        .iter()
        .map(|mode| mode_json(frames, mode))
        .collect();
    let epochs: Vec<Value> = analysis
        .record
        .epochs()
        .iter()
        .zip(&analysis.recording)
        .map(|(epoch, position)| {
            let modes: Vec<Value> = epoch
                .found
                .modes
                .iter()
                .map(|mode| {
                    json!({
                        "source": mode.source,
                        "frequency_hz": mode.frequency_hz,
                        "frequency_std_hz": mode.frequency_std_hz,
                        "damping": mode.damping,
                        "damping_std": mode.damping_std,
                    })
                })
                .collect();
            json!({
                "recording": records.name(*position),
                "end_s": epoch.end as f64 / frames.rate_hz,
                "length_s": epoch.length_s,
                "modes": modes,
            })
        })
        .collect();
    let left_out: Vec<Value> = frames
        .left_out
        .iter()
        .map(|(channel, reason)| json!({ "channel": channel, "reason": reason }))
        .collect();
    let recordings: Vec<Value> = records
        .all
        .iter()
        .map(|frames| {
            json!({ "path": frames.path.display().to_string(), "length_s": frames.length_s() })
        })
        .collect();
    let uncertain = analysis.uncertain.iter();
    let uncertain_hz: Vec<f64> = uncertain.map(|mode| mode.frequency_hz).collect();
    let all = json!({
        "path": records.path.display().to_string(),
        "recordings": recordings,
        "channels": frames.names,
        "left_out": left_out,
        "left_out_of_epochs": absent(&frames.names, analysis),
        "sampling_rate_hz": frames.rate_hz,
        "modes": modes,
        "uncertain_modes": analysis.uncertain.len(),
        "uncertain_frequencies_hz": uncertain_hz,
        "epochs": epochs,
        "declared_modes": displays(analysis).collect::<Vec<_>>(),
        "stiffness": stiffness::json(records, analysis),
        "events": events(analysis).collect::<Vec<_>>(),
    });
    format!("{all:#}\n")
}

fn mode_json(frames: &Frames, mode: &ModeSummary) -> Value {
    let shape: Vec<Value> = mode
        .best
        .channels
        .iter()
        .zip(mode.best.shape.iter())
        .zip(&mode.best.shape_std)
        .map(|((channel, value), std)| {
            json!({
                "channel": frames.names[*channel],
                "real": value.re,
                "imaginary": value.im,
                "std": std,
            })
        })
        .collect();
    let mut object = json!(mode);
    object["complexity"] = json!(1.0 - mode.collinearity);
    object["shape"] = json!(shape);
    object
}

/// Returns one row per epoch and mode as CSV. Times are seconds since the start of the recording,
/// which is numbered from 1.
pub fn csv(records: Recordings<'_>, analysis: &Analysis) -> String {
    let mut text = "recording,end [s],mode,frequency [Hz],frequency std [Hz],damping,damping std,\
                    complexity\n"
        .to_owned();
    for (epoch, position) in analysis.record.epochs().iter().zip(&analysis.recording) {
        for (mode, id) in epoch.found.modes.iter().zip(&epoch.of_mode) {
            let known = analysis
                .modes
                .iter()
                .filter(|summary| summary.source == Source::Mode)
                .position(|summary| summary.id == *id);
            let name = match (mode.source, known) {
                (Source::Machine, _) => "machine".to_owned(),
                (Source::Mode, Some(position)) => (position + 1).to_string(),
                (Source::Mode, None) => String::new(), // in too few epochs
            };
            let _ = writeln!(
                text,
                "{},{},{name},{},{},{},{},{}",
                position + 1,
                epoch.end as f64 / records.first.rate_hz,
                mode.frequency_hz,
                mode.frequency_std_hz,
                mode.damping,
                mode.damping_std,
                1.0 - mode.collinearity,
            );
        }
    }
    text
}
