//! Report of a check of a structure file, as text for people and as JSON.
//!
//! The JSON object has the following fields. Deviations and sensitivities are ratios to nominal
//! unless stated otherwise.
//!
//! - `structure`, `description`: as in the file
//! - `sampling_rate_hz`, `degrees_of_freedom`, `channels`, `nodes`: numbers of the structure
//! - `shapes`: number of shapes in which a model of more than 100 degrees of freedom was analysed,
//!   otherwise `null`
//! - `modes`: natural modes as designed, lowest first, with `frequency_hz`, `period_s`,
//!   `damping_ratio` (share of critical) and `sensitivity`. The latter is the relative change of
//!   the frequency per relative change of each parameter, in the order of `parameters`
//! - `time_step`: `highest_frequency_hz`, `rate_times_step` (bound of the highest rate times the
//!   time step), `substeps` of each step, and `series_order` (number of terms of the matrix
//!   exponential beyond the identity)
//! - `after_s`: length of the data for `std_after`
//! - `memory_s`: equivalent length of the data in fading memory. If no filter settles on this
//!   structure, `after_s` and `memory_s` are `null`, and the next three fields are empty
//! - `parameters`: list of objects with these fields: - `name`, `prior_mean`, `prior_std`,
//!   `std_after` - `std_steady`: standard deviation in the long run, with fading memory -
//!   `std_reported`: standard deviation that the filter reports in the long run - `settling_s`:
//!   time in which an error falls to 1/e (37 %), `null` for never - `dynamic_sensitivity`: shift of
//!   the predicted data of one frame for a change of 1 %, in standard deviations of the data -
//!   `verdict`: the most serious finding for the parameter, in words - `shifts`: shift of the
//!   estimate if a stated noise level is 10 % too high, in the order of `noise_levels`
//! - `noise_levels`: list of objects with these fields:
//!   - `name`, `std` as the file states it in `unit`, and whether `adapted`
//!   - `relative_std_after`: relative deviation of the level after the data, if it were adapted
//!   - `haste`: ratio of its speed of change to that of its half-life
//! - `correlations`: correlations of the parameters, then of the noise levels, row by row, if no
//!   level were known
//! - `assumptions`: assumptions that no check can verify, as words: `masses`, `damping`,
//!   `connections`, `soil`, `sensor-positions`, `temperature`
//! - `findings`, the most serious first: `severity` (`warning` or `note`), `kind` with the data of
//!   that kind, `text`, and `advice`, which is `null` if the text suffices

use crate::commands::counted;
use serde::Serialize;
use spandrel_structure::{
    Assumption, CheckReport, Finding, ModeReport, NoiseSource, ParameterReport, Severity,
    Structure, TimeStepReport,
};
use std::fmt;

/// Maximum number of modes in the text. JSON contains all modes.
const MODES_SHOWN: usize = 10;
/// Maximum number of modes whose sensitivities fit on a line.
const SENSITIVITIES_SHOWN: usize = 6;

/// Values below this limit are more legible with an exponent than with leading zeros.
const SMALL: f64 = 1e-3;

/// The report of a checked structure.
#[derive(Debug, Clone, Serialize)]
pub struct CheckPage {
    structure: String,
    description: String,
    sampling_rate_hz: f64,
    degrees_of_freedom: usize,
    channels: usize,
    nodes: usize,
    shapes: Option<usize>,
    modes: Vec<ModeReport>,
    time_step: TimeStepReport,
    after_s: Option<f64>,
    memory_s: Option<f64>,
    parameters: Vec<ParameterLine>,
    noise_levels: Vec<NoiseLevelLine>,
    correlations: Vec<Vec<f64>>,
    findings: Vec<FindingLine>,
    assumptions: Vec<Assumption>,
}

#[derive(Debug, Clone, Serialize)]
struct ParameterLine {
    name: String,
    prior_mean: f64,
    prior_std: f64,
    std_after: f64,
    std_steady: f64,
    std_reported: f64,
    settling_s: f64,
    dynamic_sensitivity: f64,
    shifts: Vec<f64>,
    verdict: String,
}

#[derive(Debug, Clone, Serialize)]
struct NoiseLevelLine {
    name: String,
    std: f64,
    unit: &'static str,
    adapted: bool,
    relative_std_after: f64,
    haste: f64,
}

#[derive(Debug, Clone, Serialize)]
struct FindingLine {
    severity: Severity,
    #[serde(flatten)]
    finding: Finding,
    text: String,
    advice: Option<String>,
}

impl CheckPage {
    /// Creates the page for `structure` from `report`.
    pub fn new(structure: &Structure, report: CheckReport) -> Self {
        let CheckReport {
            structure: name,
            shapes,
            modes,
            time_step,
            identification,
            findings,
            assumptions,
        } = report;
        let findings = findings.into_iter().map(|finding| FindingLine {
            severity: finding.severity(),
            text: finding.to_string(),
            advice: advice(structure, &finding),
            finding,
        });
        let findings: Vec<FindingLine> = findings.collect();
        let mut page = Self {
            structure: name,
            description: structure.description().to_owned(),
            sampling_rate_hz: structure.sampling_rate_hz(),
            degrees_of_freedom: modes.len(),
            channels: structure.channel_count(),
            nodes: structure.nodes().len(),
            shapes,
            modes,
            time_step,
            after_s: None,
            memory_s: None,
            parameters: Vec::new(),
            noise_levels: Vec::new(),
            correlations: Vec::new(),
            findings,
            assumptions,
        };
        if let Some(identification) = identification {
            page.after_s = Some(identification.duration_s);
            page.memory_s = Some(identification.memory_s);
            page.correlations = identification.correlations;
            let parameters = identification
                .parameters
                .into_iter()
                .zip(structure.parameters());
            let line = |(report, parameter): (ParameterReport, &spandrel_structure::Parameter)| {
                ParameterLine {
                    verdict: verdict(&report.name, &page.findings),
                    name: report.name,
                    prior_mean: parameter.mean(),
                    prior_std: report.prior_std,
                    std_after: report.std_after,
                    std_steady: report.std_steady,
                    std_reported: report.std_reported,
                    settling_s: report.settling_s,
                    dynamic_sensitivity: report.dynamic_sensitivity,
                    shifts: report.shifts,
                }
            };
            page.parameters = parameters.map(line).collect();
            let levels = identification
                .noise_levels
                .into_iter()
                .zip(structure.noise_levels());
            let line = |(report, level): (
                spandrel_structure::NoiseLevelReport,
                &spandrel_structure::NoiseLevel,
            )| {
                NoiseLevelLine {
                    name: report.name,
                    std: level.std(),
                    unit: structure.noise_unit(level),
                    adapted: report.adapted,
                    relative_std_after: report.relative_std_after,
                    haste: report.haste,
                }
            };
            page.noise_levels = levels.map(line).collect();
        }
        page
    }
}

/// Returns 0 for values that three decimals show as zero, so that no minus sign appears.
fn unsigned_zero(value: f64) -> f64 {
    if value.abs() < 0.0005 { 0.0 } else { value }
}

/// Formats a standard deviation, as a ratio to nominal.
fn deviation(value: f64) -> String {
    if value < SMALL {
        format!("{value:.1e}")
    } else {
        format!("{value:.4}")
    }
}

/// Returns the most serious finding for one parameter, in words.
fn verdict(parameter: &str, findings: &[FindingLine]) -> String {
    // A problem that persists in a longer record takes precedence.
    let rests = findings.iter().find_map(|line| match &line.finding {
        Finding::RestsOnExcitation {
            parameter: of,
            excitations,
            ..
        } if of == parameter => Some(excitations),
        _ => None,
    });
    if let Some(excitations) = rests {
        return format!("depends on {excitations}");
    }
    let mut verdicts = findings.iter().filter_map(|line| match &line.finding {
        Finding::Uninformed { parameter: of, .. } if of == parameter => {
            Some("not identified".to_owned())
        }
        Finding::ParametersConfounded { first, second, .. } if first == parameter => {
            Some(format!("confounded with {second}"))
        }
        Finding::ParametersConfounded { first, second, .. } if second == parameter => {
            Some(format!("confounded with {first}"))
        }
        Finding::LevelConfounded {
            parameter: of,
            level,
            adapted,
            ..
        } if of == parameter => Some(match adapted {
            true => format!("confounded with the level of {level}"),
            false => format!("depends on the level of {level}"),
        }),
        Finding::SlowToSettle { parameter: of, .. } if of == parameter => Some("slow".to_owned()),
        Finding::NotObservable
        | Finding::RestsOnExcitation { .. }
        | Finding::LevelAssumed { .. }
        | Finding::DampingAssumed { .. }
        | Finding::DesignTrusted { .. }
        | Finding::FewSensors { .. }
        | Finding::HoldMatters { .. }
        | Finding::ImplausiblePeriod { .. }
        | Finding::UnequalStoreys { .. }
        | Finding::LightFloors { .. }
        | Finding::ImplausibleLevel { .. }
        | Finding::NoiseAboveSignal { .. }
        | Finding::Uninformed { .. }
        | Finding::ParametersConfounded { .. }
        | Finding::LevelConfounded { .. }
        | Finding::SlowToSettle { .. }
        | Finding::HastyLevel { .. }
        | Finding::BandLimited { .. }
        | Finding::AliasedModes { .. }
        | Finding::SubstepsNeeded { .. }
        | Finding::ParticlesInTime { .. }
        | Finding::ParticlesTooSlow { .. }
        | Finding::ParticlesTooFew { .. }
        | Finding::ModesMissMass { .. } => None,
    });
    verdicts.next().unwrap_or_else(|| "identified".to_owned())
}

/// Returns the remedy for a finding, or `None` if the text of the finding states it.
fn advice(structure: &Structure, finding: &Finding) -> Option<String> {
    match finding {
        Finding::NotObservable => Some("add damping to the model, or place a sensor where that \
                                        mode moves".to_owned()),
        Finding::Uninformed { parameter, .. } => Some(format!(
            "place a sensor next to the part that {parameter} scales, measure for longer, or \
             remove the parameter and treat its value as known"
        )),
        Finding::ParametersConfounded { first, second, .. } => {
            Some(format!("place a sensor between the parts that {first} and {second} scale, or \
                          use one parameter for both"))
        }
        Finding::LevelConfounded { parameter, level, .. } => {
            let is_excitation = |source: &NoiseSource| matches!(source, NoiseSource::Excitation(_));
            let excites = structure.noise_levels().iter().any(|l| l.name() == level && is_excitation(l.source()));
            Some(if excites {
                format!(
                    "measure {level} on a channel (measured-on), or note that {parameter} is only \
                     as accurate as that level"
                )
            } else {
                format!("calibrate the noise of {level}, or note that {parameter} is only as \
                         accurate as that level")
            })
        }
        Finding::SlowToSettle { parameter, .. } => {
            Some(format!("add a sensor that is more sensitive to {parameter}, or increase \
                          sustain-s of its alert rule"))
        }
        Finding::RestsOnExcitation { parameter, excitations, .. } => Some(format!(
            "measure {excitations} on a channel (measured-on), or do not interpret smaller changes \
             of {parameter}"
        )),
        Finding::LevelAssumed { .. } => {
            Some("identify the level (omit adapt), or declare it known (level-factor = \
                  1)".to_owned())
        }
        Finding::DampingAssumed { .. } => Some(
            "identify it by a [[parameter]] with scales = \"damping\" and of = \"all\", or declare \
             it known (known = true in [damping])"
                .to_owned(),
        ),
        Finding::DesignTrusted { .. } => Some(
            "learn the reference (learn-s, or a baseline), or state how far the design may be off \
             (design-std = 0.05)"
                .to_owned(),
        ),
        Finding::FewSensors { .. } => Some("measure the response at more places, or use fewer \
                                            parameters".to_owned()),
        Finding::HoldMatters { delay_s, .. } if *delay_s > 0.0 => Some(
            "omit input-hold unless the excitation is constant between samples, as in a \
             simulation; or sample faster"
                .to_owned(),
        ),
        Finding::HoldMatters { .. } => Some("sample faster, or limit the frequency band \
                                             ([band-limit])".to_owned()),
        Finding::HastyLevel { .. }
        | Finding::ImplausiblePeriod { .. }
        | Finding::UnequalStoreys { .. }
        | Finding::LightFloors { .. }
        | Finding::ImplausibleLevel { .. }
        | Finding::NoiseAboveSignal { .. }
        | Finding::BandLimited { .. }
        | Finding::AliasedModes { .. }
        | Finding::SubstepsNeeded { .. }
        | Finding::ParticlesInTime { .. }
        | Finding::ParticlesTooSlow { .. }
        | Finding::ParticlesTooFew { .. }
        | Finding::ModesMissMass { .. } => None,
    }
}

impl fmt::Display for CheckPage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            structure,
            description,
            sampling_rate_hz,
            degrees_of_freedom,
            channels,
            nodes,
            shapes,
            ..
        } = self;
        let separator = if description.is_empty() { "" } else { ": " };
        writeln!(f, "{structure}{separator}{description}")?;
        writeln!(
            f,
            "{}, {} on {}, {sampling_rate_hz} Hz",
            counted(
                *degrees_of_freedom,
                "degree of freedom",
                "degrees of freedom"
            ),
            counted(*channels, "channel", "channels"),
            counted(*nodes, "node", "nodes")
        )?;
        if let Some(shapes) = shapes {
            writeln!(f, "analysed in {shapes} shapes")?;
        }
        self.write_modes(f)?;
        self.write_parameters(f)?;
        self.write_noise_levels(f)?;
        self.write_findings(f)
    }
}

impl CheckPage {
    fn write_modes(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "\nnatural modes as designed\n")?;
        writeln!(f, "  mode  frequency (Hz)  period (s)  damping (%)")?;
        for (mode, number) in self.modes.iter().zip(1..).take(MODES_SHOWN) {
            let ModeReport {
                frequency_hz,
                period_s,
                damping_ratio,
                ..
            } = mode;
            writeln!(
                f,
                "  {number:>4}  {frequency_hz:>14.4}  {period_s:>10.4}  {:>11.2}",
                100.0 * damping_ratio
            )?;
        }
        let TimeStepReport {
            highest_frequency_hz,
            rate_times_step,
            substeps,
            series_order,
        } = &self.time_step;
        if self.modes.len() > MODES_SHOWN {
            writeln!(
                f,
                "  and {} more, up to {highest_frequency_hz:.2} Hz",
                self.modes.len() - MODES_SHOWN
            )?;
        }
        writeln!(
            f,
            "\n  largest rate times time step (ω Δt) {rate_times_step:.3}: {} of {series_order} \
             terms per step",
            match substeps {
                1 => "1 series".to_owned(),
                several => format!("{several} substeps, each a series"),
            }
        )
    }

    fn write_parameters(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (Some(after_s), Some(memory_s)) = (self.after_s, self.memory_s) else {
            return Ok(());
        };
        if self.parameters.is_empty() {
            return writeln!(
                f,
                "\nno parameters: the filter follows the motion and the adapted noise levels only"
            );
        }
        writeln!(
            f,
            "\nparameters (ratios to nominal), with a memory of {memory_s:.1} s\n"
        )?;
        let width = self.name_width();
        let after = format!("after {after_s:.0} s");
        writeln!(
            f,
            "  {:width$}  {:>13}  {after:>12}  {:>8}  {:>8}  {:>11}  verdict",
            "parameter", "prior", "long run", "reported", "settles (s)"
        )?;
        for line in &self.parameters {
            let ParameterLine {
                name,
                prior_mean,
                prior_std,
                std_after,
                std_steady,
                std_reported,
                settling_s,
                ..
            } = line;
            let settles = if settling_s.is_finite() {
                format!("{settling_s:.1}")
            } else {
                "never".to_owned()
            };
            writeln!(
                f,
                "  {name:width$}  {prior_mean:.3} ± {prior_std:.3}  {:>12}  {:>8}  {:>8}  \
                 {settles:>11}  {}",
                deviation(*std_after),
                deviation(*std_steady),
                deviation(*std_reported),
                line.verdict
            )?;
        }
        writeln!(
            f,
            "\n  standard deviations after {after_s:.0} s and in the long run: information in the \
             data; reported: value that the filter will\n  report in the long run; settles: time \
             in which an error of the estimate falls to a third"
        )?;
        self.write_sensitivities(f, width)
    }

    fn write_sensitivities(&self, f: &mut fmt::Formatter<'_>, width: usize) -> fmt::Result {
        let shown = self.modes.len().min(SENSITIVITIES_SHOWN);
        writeln!(
            f,
            "\nsensitivity to a change of 1 %: static, of the natural frequencies (%); dynamic, \
             of the data of one frame (in their\n\
             standard deviations, rms)\n"
        )?;
        write!(f, "  {:width$}", "parameter")?;
        for number in 1..=shown {
            write!(f, "  {:>8}", format!("mode {number}"))?;
        }
        writeln!(f, "  {:>8}", "dynamic")?;
        for (index, line) in self.parameters.iter().enumerate() {
            write!(f, "  {:width$}", line.name)?;
            for mode in self.modes.iter().take(shown) {
                write!(
                    f,
                    "  {:>8.3}",
                    unsigned_zero(mode.sensitivity.get(index).copied().unwrap_or(0.0))
                )?;
            }
            writeln!(f, "  {:>8.3}", line.dynamic_sensitivity)?;
        }
        Ok(())
    }

    fn write_noise_levels(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Some(after_s) = self.after_s else {
            return Ok(());
        };
        let width = self.name_width();
        writeln!(f, "\nnoise levels (standard deviations)\n")?;
        let after = format!("known after {after_s:.0} s to");
        writeln!(
            f,
            "  {:width$}  {:>14}  {:>7}  {after:>20}",
            "noise level", "stated", "adapted"
        )?;
        for line in &self.noise_levels {
            let unit = if line.unit == "1" { "" } else { line.unit };
            let stated = if line.std < SMALL {
                format!("{:.3e} {unit}", line.std)
            } else {
                // A level derived from a spectral intensity has more digits than are significant.
                format!("{} {unit}", (line.std * 1e4).round() / 1e4)
            };
            let stated = stated.trim_end();
            let adapted = if line.adapted { "yes" } else { "no" };
            let known = format!("{:.1} %", 100.0 * line.relative_std_after);
            writeln!(
                f,
                "  {:width$}  {stated:>14}  {adapted:>7}  {known:>20}",
                line.name
            )?;
        }
        Ok(())
    }

    fn write_findings(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f)?;
        for FindingLine {
            severity,
            text,
            advice,
            ..
        } in &self.findings
        {
            let label = match severity {
                Severity::Warning => "warning",
                Severity::Note => "note",
            };
            writeln!(f, "{label}: {text}")?;
            if let Some(advice) = advice {
                writeln!(f, "  {advice}")?;
            }
        }
        if self.findings.is_empty() {
            f.write_str("no warnings")?;
            f.write_str(if self.parameters.is_empty() {
                "\n"
            } else {
                ": these sensors distinguish all parameters\n"
            })?;
        }
        writeln!(
            f,
            "\nthese results hold only if the model is right; a check cannot verify these \
             assumptions:\n"
        )?;
        self.assumptions
            .iter()
            .try_for_each(|assumption| writeln!(f, "  {assumption}"))
    }

    /// Returns the report as one line with a JSON object.
    pub fn json(&self) -> String {
        // Cannot fail, because the object contains only names and numbers.
        serde_json::to_string(self).map_or_else(|error| error.to_string(), |line| line + "\n")
    }

    /// Returns the width of the name column.
    fn name_width(&self) -> usize {
        let names = self
            .parameters
            .iter()
            .map(|line| &line.name)
            .chain(self.noise_levels.iter().map(|line| &line.name));
        names
            .map(|name| name.len())
            .max()
            .unwrap_or(0)
            .max("noise level".len())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    const DEMO: &str = include_str!("../../../docs/examples/demo.toml");
    const OUTPUT_ONLY: &str = include_str!("../../../docs/examples/output-only.toml");

    fn page(text: &str) -> CheckPage {
        let structure = Structure::parse(text, Path::new("example.toml"))
            .unwrap_or_else(|error| panic!("{error}"));
        CheckPage::new(&structure, structure.check(60.0, 1))
    }

    #[test]
    fn report_of_the_demo_lists_modes_parameters_and_levels() {
        let text = page(DEMO).to_string();
        for part in [
            "demo: five-storey building, ground motion measured",
            "5 degrees of freedom, 6 channels on 6 nodes, 100 Hz",
            // The file specifies a first frequency of 1 Hz and a damping of 2 % in modes 1 and 2.
            "     1          1.0000      1.0000         2.00\n",
            "1.000 ± 0.200",
            "0.005 m/s2",
        ] {
            assert!(text.contains(part), "no {part:?} in\n{text}");
        }
        for storey in 1..=5 {
            let is_told = |line: &str| {
                line.starts_with(&format!("  storey-{storey} ")) && line.ends_with("  identified")
            };
            assert!(
                text.lines().any(is_told),
                "storey-{storey} is not identified in\n{text}"
            );
        }
        assert!(text.contains("no warnings"), "{text}");
    }

    /// In a shear building, an increase of all stiffnesses by 1 % raises each frequency by 0.5 %.
    #[test]
    fn sensitivities_of_all_storeys_add_up_to_one_half() {
        for mode in page(DEMO).modes {
            assert!(
                (mode.sensitivity.iter().sum::<f64>() - 0.5).abs() < 1e-9,
                "{mode:?}"
            );
        }
    }

    #[test]
    fn report_advises_a_ground_sensor_if_storey_1_depends_on_the_level() {
        let text = page(OUTPUT_ONLY).to_string();
        let mut lines = text.lines();
        let finding = lines
            .find(|line| line.contains("storey-1 depends on the level and the spectrum of ground"));
        assert!(finding.is_some(), "{text}");
        assert!(
            lines
                .next()
                .is_some_and(|line| line.contains("measure ground on a channel")),
            "{text}"
        );
        assert!(text.contains("  depends on ground"), "{text}");
        assert!(
            text.contains("these results hold only if the model is right"),
            "{text}"
        );
    }

    #[test]
    fn a_fixed_damping_and_a_fixed_level_are_warnings_with_figures() {
        let file = OUTPUT_ONLY.replace("level-factor = 3 ", "adapt = false #");
        let (before, after) = file
            .split_once("[[parameter]]\nname = \"damping\"")
            .unwrap();
        let (_, after) = after.split_once("[[excitation]]").unwrap();
        let text = page(&format!("{before}[[excitation]]{after}")).to_string();
        assert!(
            text.contains(
                "warning: damping is fixed; if it is 2 times as large, or as small: storey-1 "
            ),
            "{text}"
        );
        assert!(
            text.contains("warning: the level of ground is stated and not identified; "),
            "{text}"
        );
    }

    #[test]
    fn json_has_the_documented_fields() {
        let json: serde_json::Value = serde_json::from_str(&page(OUTPUT_ONLY).json()).unwrap();
        for field in [
            "structure",
            "sampling_rate_hz",
            "degrees_of_freedom",
            "time_step",
            "after_s",
            "memory_s",
            "correlations",
        ] {
            assert!(!json[field].is_null(), "{field} in {json}");
        }
        assert_eq!(json["parameters"][0]["name"], "storey-1");
        assert_eq!(json["noise_levels"][0]["unit"], "m/s2");
        assert_eq!(
            json["modes"][0]["sensitivity"].as_array().map(Vec::len),
            Some(6)
        );
        let findings = json["findings"].as_array().unwrap();
        let rests = |f: &&serde_json::Value| {
            f["kind"] == "rests-on-excitation" && f["parameter"] == "storey-1"
        };
        let finding = findings
            .iter()
            .find(rests)
            .unwrap_or_else(|| panic!("{json}"));
        assert_eq!(
            (&finding["severity"], &finding["excitations"]),
            (&"warning".into(), &"ground".into())
        );
        assert_eq!(json["assumptions"][0], "masses");
        assert!(finding["text"].is_string() && finding["advice"].is_string());
    }
}
