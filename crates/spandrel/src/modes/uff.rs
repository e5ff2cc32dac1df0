//! Mode shapes and spectral densities as a universal file, for other programs.
//!
//! Source of the layouts: Structural Dynamics Research Corporation, *Universal File Datasets*:
//! numbers 55 (data at nodes) and 58 (function at a nodal degree of freedom). Field widths are
//! those of Fortran: `I10` is an integer of ten characters, `E13.5` a number of thirteen.

use super::analysis::Analysis;
use super::frames::Frames;
use spandrel_modal::{ChannelUse, ModeSummary, Source};
use spandrel_structure::{Direction, Structure};
use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::fmt::Write as _;

/// Longest line of text.
const LONGEST: usize = 80;
/// Longest name of a response.
const LONGEST_NAME: usize = 10;
/// Type of the motion of a shape: displacement. The ratio of two accelerations is that of the
/// displacements.
const DISPLACEMENT: usize = 8;
/// Number of the direction z.
const Z: usize = 3;
/// Type of a function: power spectral density.
const POWER_SPECTRAL_DENSITY: usize = 9;

/// Returns the node (from 1) and the direction (1 to 3: x to z) of each channel.
///
/// They are those of a structure file that gives every channel a place and a direction. Otherwise
/// each channel is a node of its own that moves along z.
fn places(frames: &Frames, structure: Option<&Structure>) -> Vec<(usize, usize)> {
    let sensors = structure.map(|structure| structure.drawing().sensors);
    let sensors = sensors.unwrap_or_default();
    let of_channel = frames.names.iter().map(|name| {
        let sensor = sensors.iter().find(|sensor| sensor.channel == *name)?;
        let direction = match sensor.direction? {
            Direction::X => 1,
            Direction::Y => 2,
            Direction::Z => Z,
        };
        Some((sensor.point? + 1, direction))
    });
    let of_structure: Option<Vec<(usize, usize)>> = of_channel.collect();
    of_structure.unwrap_or_else(|| (1..=frames.names.len()).map(|node| (node, Z)).collect())
}

/// Returns a universal file with a dataset 55 per mode, and a dataset 58 with the mean spectral
/// density of each channel in each band.
pub fn file(frames: &Frames, analysis: &Analysis, structure: Option<&Structure>) -> String {
    let places = places(frames, structure);
    let mut text = String::new();
    let modes = analysis.modes.iter();
    for (mode, number) in modes.filter(|mode| mode.source == Source::Mode).zip(1..) {
        shape(&mut text, mode, number, &places);
    }
    for (position, band) in analysis.bands.iter().enumerate() {
        for channel in 0..frames.names.len() {
            let of_channel = density(analysis, position, channel, band.highest_hz);
            if let Some((step_hz, values)) = of_channel {
                let name = &frames.names[channel];
                function(&mut text, name, places[channel], step_hz, &values);
            }
        }
    }
    text
}

/// Writes a shape as dataset 55.
fn shape(text: &mut String, mode: &ModeSummary, number: usize, places: &[(usize, usize)]) {
    begin(text, 55);
    line(
        text,
        &format!("mode {number} at {:.4} Hz", mode.frequency_hz),
    );
    line(
        text,
        &format!("frequency std {:.4} Hz", mode.frequency_std_hz),
    );
    line(
        text,
        &format!(
            "damping {:.3} %, std {:.3} %",
            100.0 * mode.damping,
            100.0 * mode.damping_std
        ),
    );
    line(text, "spandrel modes");
    line(text, "NONE");
    // Structure (1), complex eigenvalue (3), three degrees of freedom (2), displacement, complex
    // values (5), three per node.
    integers(text, &[1, 3, 2, DISPLACEMENT, 5, 3]);
    // Two integers and six reals: load case, number of the mode; λ, modal A, modal B.
    integers(text, &[2, 6, 1, number]);
    let omega = TAU * mode.frequency_hz;
    let damped = omega * (1.0 - mode.damping * mode.damping).max(0.0).sqrt();
    reals(text, &[-mode.damping * omega, damped, 0.0, 0.0, 0.0, 0.0]);
    let mut of_nodes: BTreeMap<usize, Vec<f64>> = BTreeMap::new();
    for (channel, value) in mode.best.channels.iter().zip(mode.best.shape.iter()) {
        let (node, direction) = places[*channel];
        let values = of_nodes.entry(node).or_insert_with(|| vec![0.0; 6]);
        let first = 2 * (direction - 1);
        (values[first], values[first + 1]) = (value.re, value.im);
    }
    for (node, values) in of_nodes {
        integers(text, &[node]);
        reals(text, &values);
    }
    end(text);
}

/// Returns the distance of frequencies (Hz) and the mean density of a channel over the epochs in
/// which it took part, up to `highest_hz`.
fn density(
    analysis: &Analysis,
    band: usize,
    channel: usize,
    highest_hz: f64,
) -> Option<(f64, Vec<f64>)> {
    let mut sum: Vec<f64> = Vec::new();
    let mut count = 0.0;
    let mut step_hz = None;
    for epoch in &analysis.epochs {
        let epoch = &epoch.bands[band];
        let is_used = |channel: &&ChannelUse| **channel == ChannelUse::Used;
        let (Some(spectrum), Some(ChannelUse::Used)) =
            (&epoch.spectrum, epoch.channels.get(channel))
        else {
            continue;
        };
        // The spectrum contains the usable channels only.
        let position = epoch.channels[..channel].iter().filter(is_used).count();
        let density = spectrum.density(position);
        sum.resize(density.len(), 0.0);
        sum.iter_mut()
            .zip(&density)
            .for_each(|(sum, value)| *sum += value);
        count += 1.0;
        step_hz = Some(spectrum.step_hz());
    }
    let step_hz = step_hz?;
    sum.truncate((highest_hz / step_hz).floor() as usize + 1);
    Some((step_hz, sum.iter().map(|sum| sum / count).collect()))
}

/// Writes a power spectral density as dataset 58 with even frequencies.
fn function(
    text: &mut String,
    name: &str,
    (node, direction): (usize, usize),
    step_hz: f64,
    values: &[f64],
) {
    begin(text, 58);
    line(text, name);
    line(text, "spectral density, mean of the epochs");
    line(text, "NONE");
    line(text, "spandrel modes");
    line(text, "NONE");
    let short: String = printable(name).chars().take(LONGEST_NAME).collect();
    let _ = writeln!(
        text,
        "{POWER_SPECTRAL_DENSITY:>5}{:>10}{:>5}{:>10} {short:<10}{node:>10}{direction:>4} \
         {:<10}{node:>10}{direction:>4}",
        0, 0, 0, short
    );
    // Real, single precision (2), even frequencies (1).
    let _ = writeln!(
        text,
        "{:>10}{:>10}{:>10}{}{}{}",
        2,
        values.len(),
        1,
        e(0.0),
        e(step_hz),
        e(0.0)
    );
    // Frequency (18), general (1) in the unit of the channel squared per Hz, and no other axes.
    for (kind, label) in [(18, "Frequency"), (1, "Density"), (0, "NONE"), (0, "NONE")] {
        let _ = writeln!(
            text,
            "{kind:>10}{:>5}{:>5}{:>5} {label:<20} {:<20}",
            0, 0, 0, "NONE"
        );
    }
    reals(text, values);
    end(text);
}

fn begin(text: &mut String, dataset: u32) {
    let _ = writeln!(text, "{:>6}\n{dataset:>6}", -1);
}

fn end(text: &mut String) {
    let _ = writeln!(text, "{:>6}", -1);
}

fn line(text: &mut String, content: &str) {
    let shown: String = printable(content).chars().take(LONGEST).collect();
    let _ = writeln!(text, "{shown}");
}

/// Replaces what is not printable ASCII, which other programs may not read.
fn printable(content: &str) -> String {
    let shown = |letter: char| match letter {
        ' '..='~' => letter,
        _ => '_',
    };
    content.chars().map(shown).collect()
}

fn integers(text: &mut String, values: &[usize]) {
    for value in values {
        let _ = write!(text, "{value:>10}");
    }
    text.push('\n');
}

/// Writes six numbers per line.
fn reals(text: &mut String, values: &[f64]) {
    for values in values.chunks(6) {
        values.iter().for_each(|value| text.push_str(&e(*value)));
        text.push('\n');
    }
}

/// Formats a number as `E13.5`.
fn e(value: f64) -> String {
    let text = format!("{value:.5E}");
    let (mantissa, exponent) = text.split_once('E').unwrap_or((&text, "0"));
    let (sign, digits) = match exponent.strip_prefix('-') {
        Some(digits) => ('-', digits),
        None => ('+', exponent),
    };
    format!("{:>13}", format!("{mantissa}E{sign}{digits:0>2}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_thirteen_characters() {
        for (value, expected) in [
            (0.0, "  0.00000E+00"),
            (-1.0, " -1.00000E+00"),
            (123_456.7, "  1.23457E+05"),
            (-9.999_999e-13, " -1.00000E-12"),
            (1e-100, " 1.00000E-100"),
        ] {
            assert_eq!(e(value), expected);
        }
    }

    #[test]
    fn texts_are_short_and_printable() {
        let mut text = String::new();
        line(&mut text, &format!("größe\n{}", "x".repeat(100)));
        assert_eq!(text.len(), LONGEST + 1);
        assert!(text.starts_with("gr__e_x"), "{text}");
    }
}
