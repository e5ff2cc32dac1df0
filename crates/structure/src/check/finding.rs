//! Findings of a check, as data and as sentences.

use super::{IdentificationReport, ModeReport, TimeStepReport};
use crate::structure::Structure;
use serde::Serialize;
use spandrel_filter::fusion::compression::MISSED_MASS;
use std::fmt;

/// Correlation above which two quantities cannot be distinguished.
const CONFOUNDED: f64 = 0.98;
/// A parameter is not identified if its standard deviation stays above this share of its prior.
const INFORMED: f64 = 0.5;
/// Smallest shift worth a note if a level is 10 % off: the size of a small damage.
const NOTABLE_SHIFT: f64 = 0.02;
/// Number of memories within which the filter must forget an error.
///
/// If it needs more, it has counted data that contained no information.
const SLOW: f64 = 2.0;
/// Ratio to its half-life rate above which an adapted level follows single gusts and shocks.
const HASTY: f64 = 5.0;

/// Severity of a finding.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Severity {
    /// The file requests something that these sensors cannot provide.
    Warning,
    /// The file is usable; the finding names an assumption behind its results.
    Note,
}

/// Error of one parameter (ratio to nominal) caused by a wrong value of another quantity.
///
/// The finding that contains the shift states the quantity and the factor by which its value is
/// wrong.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Shift {
    /// Name of the parameter.
    pub parameter: String,
    /// Shift of the estimate (ratio to nominal) if the true value of the other quantity is the
    /// stated value divided by the factor.
    pub if_less: f64,
    /// Shift of the estimate (ratio to nominal) if the true value of the other quantity is the
    /// stated value times the factor.
    pub if_more: f64,
}

/// One finding of a check.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "kind", rename_all = "kebab-case")]
pub enum Finding {
    /// A mode is neither damped nor observed, so no filter converges.
    NotObservable,
    /// The data contain little information about a parameter.
    Uninformed {
        /// Name of the parameter.
        parameter: String,
        /// Expected standard deviation after the duration, as a share of the prior standard
        /// deviation.
        ratio: f64,
    },
    /// Two parameters have the same effect on these sensors.
    ParametersConfounded {
        /// The first parameter.
        first: String,
        /// The second parameter.
        second: String,
        /// Correlation of the two parameters.
        correlation: f64,
    },
    /// These sensors cannot distinguish a change of a parameter from a change of a noise level.
    LevelConfounded {
        /// Name of the parameter.
        parameter: String,
        /// Name of the noise level.
        level: String,
        /// Correlation of the two, if the level is unknown.
        correlation: f64,
        /// Shift of the parameter if the level is stated 10 % too high.
        shift: f64,
        /// `true` if the file requests adaptation of the level.
        adapted: bool,
    },
    /// The filter will report too small a standard deviation for a parameter and correct errors
    /// slowly.
    SlowToSettle {
        /// Name of the parameter.
        parameter: String,
        /// Time (s) in which the filter reduces an error to 1/e (37 %).
        settling_s: f64,
        /// Length of the memory of the filter (s), which would be the time without this finding.
        memory_s: f64,
    },
    /// An adapted noise level will follow every burst.
    HastyLevel {
        /// Name of the noise level.
        level: String,
        /// Ratio of its rate to the rate that its half-life implies.
        haste: f64,
    },
    /// The data are limited to a band, which the analysis does not take into account.
    BandLimited {
        /// Corner frequency (Hz).
        frequency_hz: f64,
    },
    /// Some modes of the model are above half the sampling rate.
    AliasedModes {
        /// Number of modes above half the sampling rate.
        modes: usize,
        /// Number of all modes.
        of: usize,
        /// Half the sampling rate (Hz).
        nyquist_hz: f64,
    },
    /// The highest frequency of the model requires substeps in each time step.
    SubstepsNeeded {
        /// Number of substeps in each step.
        substeps: usize,
        /// Highest natural frequency of the model (Hz).
        highest_frequency_hz: f64,
    },
    /// A parameter cannot be distinguished from the level and the colour of an unmeasured
    /// excitation.
    RestsOnExcitation {
        /// Name of the parameter.
        parameter: String,
        /// Names of the unmeasured excitations.
        excitations: String,
        /// Standard deviation of its error (ratio to nominal).
        error: f64,
    },
    /// The level of an unmeasured excitation is stated and not identified.
    LevelAssumed {
        /// Name of the level.
        level: String,
        /// Factor by which the level may be wrong.
        factor: f64,
        /// Effect of such an error on each parameter.
        shifts: Vec<Shift>,
    },
    /// Damping is neither identified nor stated to be known.
    DampingAssumed {
        /// Factor by which the damping may be wrong.
        factor: f64,
        /// Effect of such an error on each parameter.
        shifts: Vec<Shift>,
    },
    /// An alert rule compares with the design and trusts it more than a design can be known.
    DesignTrusted {
        /// Stated standard deviation of the design (ratio to nominal).
        std: f64,
    },
    /// Few sensors measure the response of many parts.
    FewSensors {
        /// Number of channels that measure the response.
        channels: usize,
        /// Number of parameters that scale stiffness.
        parameters: usize,
    },
    /// The hold of a measured excitation between frames changes the input of the model.
    HoldMatters {
        /// Upper end of the recorded band (Hz).
        frequency_hz: f64,
        /// Share of the excitation lost at that frequency.
        loss: f64,
        /// Delay of the excitation (s).
        delay_s: f64,
        /// Combined effect of loss and delay, as a share of the excitation.
        error: f64,
    },
    /// The period is implausible for a building with this number of storeys.
    ImplausiblePeriod {
        /// Number of storeys.
        storeys: usize,
        /// Fundamental period as designed (s).
        period_s: f64,
        /// Plausible range (s).
        expected_s: (f64, f64),
        /// Unit mistake that explains the period, if any.
        cause: Option<String>,
    },
    /// The values of two neighbouring storeys differ so much that one may be in a wrong unit.
    UnequalStoreys {
        /// `mass` or `stiffness`.
        what: String,
        /// The lower storey (from 1).
        lower: usize,
        /// Ratio of the larger to the smaller value.
        ratio: f64,
    },
    /// The floors are too light for a building.
    LightFloors {
        /// Mass of the heaviest floor (kg).
        heaviest_kg: f64,
    },
    /// The stated ground motion is implausibly weak or strong.
    ImplausibleLevel {
        /// Name of the excitation.
        excitation: String,
        /// Stated standard deviation (m/s²).
        std: f64,
    },
    /// A sensor shows more noise than motion.
    NoiseAboveSignal {
        /// Name of the channel.
        channel: String,
        /// Standard deviation of the noise.
        noise: f64,
        /// Standard deviation of the expected motion.
        signal: f64,
        /// Unit of both standard deviations.
        unit: String,
    },
    /// Particles are fast enough for the sampling rate.
    ParticlesInTime {
        /// Estimated time of a step (s) on one core.
        needed_s: f64,
        /// Time between two frames (s).
        step_s: f64,
    },
    /// Particles are too slow for the sampling rate.
    ParticlesTooSlow {
        /// Estimated time of a step (s) on one core.
        needed_s: f64,
        /// Time between two frames (s).
        step_s: f64,
    },
    /// The state is too large for the number of particles.
    ParticlesTooFew {
        /// Number of states and parameters.
        states: usize,
        /// Number of particles.
        particles: usize,
    },
    /// The modes that nodes send omit too much of the motion.
    ModesMissMass {
        /// Number of modes that nodes send.
        modes: usize,
        /// Share of the mass excited by the excitation that these modes omit.
        missed: f64,
    },
}

impl Finding {
    /// Returns the severity of the finding.
    #[must_use]
    pub fn severity(&self) -> Severity {
        match self {
            Self::NotObservable
            | Self::Uninformed { .. }
            | Self::ParametersConfounded { .. }
            | Self::LevelConfounded { adapted: true, .. }
            | Self::SlowToSettle { .. }
            | Self::ModesMissMass { .. }
            | Self::RestsOnExcitation { .. }
            | Self::LevelAssumed { .. }
            | Self::DampingAssumed { .. }
            | Self::DesignTrusted { .. }
            | Self::HoldMatters { .. }
            | Self::ImplausiblePeriod { .. }
            | Self::UnequalStoreys { .. }
            | Self::ImplausibleLevel { .. }
            | Self::NoiseAboveSignal { .. }
            | Self::ParticlesTooSlow { .. }
            | Self::ParticlesTooFew { .. }
            | Self::HastyLevel { .. } => Severity::Warning,
            Self::LevelConfounded { adapted: false, .. }
            | Self::FewSensors { .. }
            | Self::LightFloors { .. }
            | Self::BandLimited { .. }
            | Self::AliasedModes { .. }
            | Self::ParticlesInTime { .. }
            | Self::SubstepsNeeded { .. } => Severity::Note,
        }
    }
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotObservable => f.write_str(
                "a mode is neither damped nor observed by a sensor: no filter converges",
            ),
            Self::Uninformed { parameter, ratio } => write!(
                f,
                "{parameter}: the sensors provide little information about it; its standard \
                 deviation stays at {:.0} % of the prior",
                100.0 * ratio
            ),
            Self::ParametersConfounded {
                first,
                second,
                correlation,
            } => {
                write!(
                    f,
                    "the sensors cannot distinguish {first} from {second} (correlation \
                     {correlation:.3})"
                )
            }
            Self::LevelConfounded {
                parameter,
                level,
                correlation,
                shift,
                adapted,
            } => {
                write!(
                    f,
                    "the sensors cannot reliably distinguish {parameter} from the level of \
                     {level}: a level stated 10 % too \
                     high shifts {parameter} by {:+.1} % (correlation {correlation:.2})",
                    100.0 * shift
                )?;
                f.write_str(if *adapted {
                    "; the file requests to adapt that level: state or measure it instead"
                } else {
                    "; the result depends on the stated level; do not adapt that level"
                })
            }
            Self::SlowToSettle {
                parameter,
                settling_s,
                memory_s,
            } if settling_s.is_infinite() => write!(
                f,
                "{parameter}: an error of the filter hardly decays, although its memory is \
                 {memory_s:.0} s, and the reported interval is too narrow"
            ),
            Self::SlowToSettle {
                parameter,
                settling_s,
                memory_s,
            } => write!(
                f,
                "{parameter}: an error of the filter decays within {settling_s:.0} s instead of \
                 the {memory_s:.0} s of its memory, and the reported interval is too narrow until \
                 then"
            ),
            Self::HastyLevel { level, haste } => write!(
                f,
                "the level of {level} would be adapted {haste:.0} times faster than its half-life \
                 allows: increase noise-half-life-s by that factor, or state the level"
            ),
            Self::BandLimited { frequency_hz } => write!(
                f,
                "the deviations apply to the whole band, but the data are cut off above the \
                 declared limit of {frequency_hz} Hz and contain less information"
            ),
            Self::AliasedModes {
                modes,
                of,
                nyquist_hz,
            } => write!(
                f,
                "{modes} of {of} modes lie above {nyquist_hz} Hz, half the sampling rate: their \
                 vibration aliases to lower frequencies unless it is filtered before sampling; \
                 use a higher rate or a coarser model"
            ),
            Self::SubstepsNeeded {
                substeps,
                highest_frequency_hz,
            } => write!(
                f,
                "each time step is cut into {substeps} substeps, because the model reaches \
                 {highest_frequency_hz:.1} Hz: a higher sampling rate or a coarser model would be \
                 cheaper"
            ),
            Self::RestsOnExcitation {
                parameter,
                excitations,
                error,
            } => write!(
                f,
                "{parameter} depends on the level and the spectrum of {excitations}, which no \
                 sensor measures: it stays uncertain by \
                 {:.1} %, however long the record",
                100.0 * error
            ),
            Self::LevelAssumed {
                level,
                factor,
                shifts,
            } => {
                write!(
                    f,
                    "the level of {level} is stated and not identified; if it is {factor} times \
                     as large, or as small: "
                )?;
                write_shifts(f, shifts)
            }
            Self::DampingAssumed { factor, shifts } => {
                write!(
                    f,
                    "damping is fixed; if it is {factor} times as large, or as small: "
                )?;
                write_shifts(f, shifts)
            }
            Self::DesignTrusted { std } => write!(
                f,
                "an alert rule compares with the design and trusts it to {} %; masses and \
                 stiffnesses of a design are rarely known to 5 %, and a larger error raises alerts \
                 on undamaged parts",
                100.0 * std
            ),
            Self::FewSensors {
                channels,
                parameters,
            } => write!(
                f,
                "{channels} {} for {parameters} stiffness parameters: after a large sudden loss, \
                 the filter can attribute it to the wrong part",
                match channels {
                    1 => "channel measures the response",
                    _ => "channels measure the response",
                }
            ),
            Self::HoldMatters {
                frequency_hz,
                loss,
                delay_s,
                error,
            } => {
                write!(f, "between frames the measured excitation ")?;
                match *delay_s > 0.0 {
                    true => write!(f, "is held, which delays it by {:.1} ms: ", 1e3 * delay_s)?,
                    false => write!(f, "is interpolated linearly: ")?,
                }
                write!(
                    f,
                    "at {frequency_hz:.1} Hz, where the recorded band ends, {:.1} % of it is lost \
                     and its error is {:.0} %",
                    100.0 * loss,
                    100.0 * error
                )
            }
            Self::ImplausiblePeriod {
                storeys,
                period_s,
                expected_s: (low, high),
                cause,
            } => {
                write!(
                    f,
                    "a building of {storeys} storeys with a period of {period_s:.3} s is \
                     implausible, such buildings have {low:.2} to {high:.1} s"
                )?;
                cause
                    .as_ref()
                    .map_or(Ok(()), |cause| write!(f, "; {cause}"))
            }
            Self::UnequalStoreys { what, lower, ratio } => write!(
                f,
                "the {what} of storeys {lower} and {} differs by a factor of {ratio:.0}: is one \
                 of them in another unit?",
                lower + 1
            ),
            Self::LightFloors { heaviest_kg } => write!(
                f,
                "no floor weighs more than {heaviest_kg} kg: plausible for a bench model; for a \
                 building, masses must be in kg"
            ),
            Self::ImplausibleLevel { excitation, std } => write!(
                f,
                "{excitation} has a standard deviation of {std:e} m/s2, which is implausible for \
                 a ground motion: its unit must be m/s2, not g, cm/s2 or mm/s2"
            ),
            Self::NoiseAboveSignal {
                channel,
                noise,
                signal,
                unit,
            } => write!(
                f,
                "{channel} has a noise of {noise:.2e} {unit}, and {signal:.2e} {unit} of expected \
                 motion: use a better sensor or a stronger excitation, or check the units of both \
                 (g instead of m/s2)"
            ),
            Self::ParticlesInTime { needed_s, step_s } => write!(
                f,
                "a step of the particles takes about {:.1} ms on one core, and frames come every \
                 {:.1} ms: fast enough",
                1e3 * needed_s,
                1e3 * step_s
            ),
            Self::ParticlesTooSlow { needed_s, step_s } => write!(
                f,
                "a step of the particles takes about {:.1} ms on one core, and frames come every \
                 {:.1} ms: the service falls behind; use fewer particles, density = \"prior\", or \
                 a lower sampling rate",
                1e3 * needed_s,
                1e3 * step_s
            ),
            Self::ParticlesTooFew { states, particles } => write!(
                f,
                "{particles} particles for {states} states and parameters: the required number of \
                 particles grows exponentially with them, and with too few particles the \
                 intervals are much too narrow"
            ),
            Self::ModesMissMass { modes, missed } => write!(
                f,
                "the {modes} modes that nodes send miss {:.0} % of the excited mass: specify more \
                 modes, or omit the setting to send as many as necessary",
                100.0 * missed
            ),
        }
    }
}

/// Maximum number of shifts in a sentence.
const NAMED_SHIFTS: usize = 5;

/// Writes the parameters with the largest shifts, in state order.
fn write_shifts(f: &mut fmt::Formatter<'_>, shifts: &[Shift]) -> fmt::Result {
    let largest = |shift: &Shift| shift.if_less.abs().max(shift.if_more.abs());
    let mut sizes: Vec<f64> = shifts.iter().map(largest).collect();
    sizes.sort_by(|a, b| b.total_cmp(a));
    let least = sizes.get(NAMED_SHIFTS - 1).copied().unwrap_or(0.0);
    let named = shifts
        .iter()
        .filter(|shift| largest(shift) >= least)
        .take(NAMED_SHIFTS);
    for (
        number,
        Shift {
            parameter,
            if_less,
            if_more,
        },
    ) in named.enumerate()
    {
        let separator = if number == 0 { "" } else { ", " };
        write!(
            f,
            "{separator}{parameter} {:+.1} or {:+.1} %",
            100.0 * if_more,
            100.0 * if_less
        )?;
    }
    if shifts.len() > NAMED_SHIFTS {
        f.write_str(", the others less")
    } else {
        Ok(())
    }
}

/// Collects the findings, warnings first.
pub(super) fn find(
    structure: &Structure,
    identification: Option<&IdentificationReport>,
    time_step: &TimeStepReport,
    modes: &[ModeReport],
) -> Vec<Finding> {
    let mut findings = match identification {
        None => vec![Finding::NotObservable],
        Some(identification) => of_identification(structure, identification),
    };
    findings.extend(structure.design_findings());
    findings.extend(structure.assumption_findings());
    if let Some(limit) = structure.band_limit() {
        findings.push(Finding::BandLimited {
            frequency_hz: limit.frequency_hz,
        });
    }
    let nyquist_hz = structure.sampling_rate_hz() / 2.0;
    let above = modes
        .iter()
        .filter(|mode| mode.frequency_hz > nyquist_hz)
        .count();
    if above > 0 {
        findings.push(Finding::AliasedModes {
            modes: above,
            of: modes.len(),
            nyquist_hz,
        });
    }
    if time_step.substeps > 1 {
        let TimeStepReport {
            substeps,
            highest_frequency_hz,
            ..
        } = *time_step;
        findings.push(Finding::SubstepsNeeded {
            substeps,
            highest_frequency_hz,
        });
    }
    if let Some(modes) = structure
        .sent_modes()
        .filter(|modes| modes.missed_mass > MISSED_MASS)
    {
        findings.push(Finding::ModesMissMass {
            modes: modes.count,
            missed: modes.missed_mass,
        });
    }
    findings.sort_by_key(Finding::severity);
    findings
}

fn of_identification(structure: &Structure, report: &IdentificationReport) -> Vec<Finding> {
    let mut findings = Vec::new();
    let parameters = &report.parameters;
    for (index, parameter) in parameters.iter().enumerate() {
        let ratio = parameter.std_after / parameter.prior_std;
        if ratio > INFORMED {
            findings.push(Finding::Uninformed {
                parameter: parameter.name.clone(),
                ratio,
            });
        }
        for (other, second) in parameters.iter().enumerate().skip(index + 1) {
            let correlation = report.correlations[index][other];
            if correlation.abs() > CONFOUNDED {
                let (first, second) = (parameter.name.clone(), second.name.clone());
                findings.push(Finding::ParametersConfounded {
                    first,
                    second,
                    correlation,
                });
            }
        }
        for (level_index, level) in report.noise_levels.iter().enumerate() {
            let (correlation, shift) = (
                report.correlations[index][parameters.len() + level_index],
                parameter.shifts[level_index],
            );
            // `RestsOnExcitation` covers the unmeasured excitations, together with their colour.
            let told = structure.is_unknown(level_index);
            if !told && (correlation.abs() > CONFOUNDED || shift.abs() > NOTABLE_SHIFT) {
                findings.push(Finding::LevelConfounded {
                    parameter: parameter.name.clone(),
                    level: level.name.clone(),
                    correlation,
                    shift,
                    adapted: level.adapted,
                });
            }
        }
        // A parameter without information does not settle in any case.
        let slow = parameter.settling_s > SLOW * report.memory_s;
        if slow && ratio <= INFORMED {
            findings.push(Finding::SlowToSettle {
                parameter: parameter.name.clone(),
                settling_s: parameter.settling_s,
                memory_s: report.memory_s,
            });
        }
    }
    for level in report
        .noise_levels
        .iter()
        .filter(|level| level.adapted && level.haste > HASTY)
    {
        findings.push(Finding::HastyLevel {
            level: level.name.clone(),
            haste: level.haste,
        });
    }
    findings
}
