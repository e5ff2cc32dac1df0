//! The judgement of an event in numbers, as the JSON file of the report contains it.

use super::event_record::{EventRecord, SensorFigures, SpectralValue, fundamental_hz, spectrum};
use super::identified::{Identified, ResponsePeak};
use super::wording;
use crate::error::AppError;
use crate::sensor_report::{advice, word};
use crate::summary::{AlertSummary, FitSummary, Samples};
use jiff::Timestamp;
use serde::Serialize;
use spandrel_bus::AlertState;
use spandrel_earthquake::{
    Coverage, EventCourse, EventJudgement, Interval, JudgeSettings, LastingLoss, Urgency, Window,
};
use spandrel_faults::{ChannelHealth, Fault, Soundness};
use spandrel_structure::{EarthquakePlan, Structure};

/// Kind of the JSON files, by which the list of a folder recognises them.
pub const KIND: &str = "spandrel-earthquake-report";
/// Periods of the drawn spectrum (s).
const SPECTRUM_PERIODS: usize = 80;
const SPECTRUM_FROM_S: f64 = 0.04;
const SPECTRUM_TO_S: f64 = 4.0;

/// An event in a list.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EventName {
    /// Name of the files of the report, without extension.
    pub event: String,
    /// Name of the recording.
    pub record: String,
    /// Time of the first sample (UTC). `None` if the recording has no dates.
    pub start: Option<String>,
}

impl EventName {
    /// Returns the name of an event of a structure.
    pub fn new(structure: &Structure, record: &EventRecord) -> Self {
        let file = record.path.file_name().unwrap_or(record.path.as_os_str());
        let file = file.to_string_lossy().into_owned();
        let start = record.date();
        let name = match &start {
            Some(start) => start.replace(':', "-"),
            None => {
                let stem = record.path.file_stem().unwrap_or(record.path.as_os_str());
                let safe = |c: char| {
                    if c.is_alphanumeric() || c == '-' {
                        c
                    } else {
                        '_'
                    }
                };
                stem.to_string_lossy().chars().map(safe).collect()
            }
        };
        Self {
            event: format!("{}_{name}", structure.name()),
            record: file,
            start,
        }
    }

    /// Returns the time for people, or the name of the recording.
    pub fn title(&self) -> String {
        let time = self
            .start
            .as_ref()
            .and_then(|start| start.parse::<Timestamp>().ok());
        time.map_or_else(
            || self.record.clone(),
            |time| time.strftime("%-d %B %Y, %H:%M UTC").to_string(),
        )
    }
}

/// The health of a sensor.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct HealthReport {
    /// `sound`, `in doubt`, `faulty`, `unchecked` or `not checked`.
    pub state: &'static str,
    /// Probability of a fault.
    pub probability: Option<f64>,
    /// The most probable fault.
    pub fault: Option<String>,
    /// What to look at first.
    pub advice: Option<&'static str>,
}

impl HealthReport {
    fn new(health: Option<&ChannelHealth>) -> Self {
        let Some(health) = health else {
            return Self {
                state: "not checked",
                probability: None,
                fault: None,
                advice: None,
            };
        };
        Self {
            state: word(health.soundness),
            probability: Some(health.probability),
            fault: health.fault.map(Fault::words),
            advice: health.fault.map(advice),
        }
    }

    /// Returns `true` if a fault is probable.
    pub fn is_suspected(&self) -> bool {
        [Soundness::InDoubt, Soundness::Faulty]
            .map(word)
            .contains(&self.state)
    }
}

/// A sensor of the report.
#[derive(Debug, Clone, Serialize)]
pub struct SensorReport {
    /// Peak, intensity and spectral values.
    #[serde(flatten)]
    pub figures: SensorFigures,
    /// Agreement with the other sensors.
    pub health: HealthReport,
}

/// The weak motion of one event, in the comparison of all events.
#[derive(Debug, Clone, Serialize)]
pub struct ComparedEvent {
    /// The event.
    #[serde(flatten)]
    pub name: EventName,
    /// Stiffness in weak motion (ratio to nominal). `None` if the record shows no weak motion.
    pub stiffness: Option<f64>,
    /// Interval of the stiffness within the record (ratio to nominal). `None` if the record shows
    /// no weak motion.
    pub within: Option<Interval>,
    /// Softest moment of the shaking (ratio to nominal). `None` without shaking.
    pub softest: Option<f64>,
}

/// Where a stiffness comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Source {
    /// The fit of all members together to each window.
    WholeStructure,
    /// The filter, which identifies each parameter of the structure file.
    Parameter,
}

/// A stiffness of the report.
#[derive(Debug, Clone, Serialize)]
pub struct ParameterReport {
    /// Name of the parameter, or of the whole structure.
    pub name: String,
    /// Origin of the stiffness.
    pub source: Source,
    /// Course over the windows, as ln k.
    pub course: EventCourse,
    /// The judgement.
    pub judgement: EventJudgement,
    /// This event and all earlier ones, in the order of time.
    pub events: Vec<ComparedEvent>,
    /// Interval of the stiffness in weak motion that the earlier events predict (ratio to nominal).
    pub expected: Option<Interval>,
    /// How often an event lies in the interval that the others predict, among all so far.
    pub coverage: Coverage,
}

/// Settings that decide.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ReportSettings {
    /// Loss that matters (share).
    pub loss: f64,
    /// Probability of a loss at and above which the loss is raised, 0 to 1.
    pub credibility: f64,
    /// Peak of the response above which motion is strong (m/s²).
    pub strong_above_m_per_s2: f64,
}

/// Ratio of peak to root mean square of a window of earthquake motion.
const PEAK_FACTOR: f64 = 3.0;

impl ReportSettings {
    /// Returns the settings of a structure file, or those of one without `[earthquakes]`.
    pub fn of(plan: Option<&EarthquakePlan>) -> Self {
        Self {
            loss: plan.map_or(EarthquakePlan::LOSS, |plan| plan.loss),
            credibility: plan.map_or(EarthquakePlan::CREDIBILITY, |plan| plan.credibility),
            strong_above_m_per_s2: plan
                .map_or(EarthquakePlan::STRONG_M_PER_S2, |plan| plan.strong_m_per_s2),
        }
    }

    /// Returns the settings of the judgement.
    pub fn judge(&self) -> JudgeSettings {
        JudgeSettings {
            loss: self.loss,
            credibility: self.credibility,
            level: 0.95,
            weak_amplitude: (self.strong_above_m_per_s2 / PEAK_FACTOR).log10(),
        }
    }
}

/// The report of one event.
#[derive(Debug, Clone, Serialize)]
pub struct EventReport {
    /// [`KIND`].
    pub kind: &'static str,
    /// Name of the structure.
    pub structure: String,
    /// Description of the structure.
    pub description: String,
    /// The event.
    #[serde(flatten)]
    pub name: EventName,
    /// Number of the event in the order of the command, from 1.
    pub number: usize,
    /// Sampling rate (Hz).
    pub sampling_rate_hz: f64,
    /// Length of the record (s).
    pub length_s: f64,
    /// Fundamental frequency as designed (Hz).
    pub fundamental_hz: f64,
    /// What decides.
    pub settings: ReportSettings,
    /// Urgency of an inspection after the event.
    pub urgency: Urgency,
    /// Rank of the urgency, 1 = most urgent.
    pub rank: u8,
    /// The result in one or two sentences.
    pub headline: String,
    /// What happened, sentence by sentence.
    pub happened: Vec<String>,
    /// What is judged.
    pub judged: Vec<String>,
    /// What is not judged, and why.
    pub not_judged: Vec<String>,
    /// Alerts of the running services that were open when the report was made, in words.
    pub open_alerts: Vec<String>,
    /// Alerts that are raised at the end of a record of weak motion, in words.
    pub alerts: Vec<String>,
    /// Largest acceleration of the structure (m/s²).
    pub peak_m_per_s2: f64,
    /// The sensors.
    pub sensors: Vec<SensorReport>,
    /// Displacements and drifts of the model (m), or the responses of the structure file.
    pub responses: Vec<ResponsePeak>,
    /// Reason why there are no responses. `None` if there are any.
    pub no_responses: Option<&'static str>,
    /// Spectrum of each measured ground motion (m/s²).
    pub ground_spectra: Vec<GroundSpectrum>,
    /// Windows of the record.
    pub windows: Vec<Window>,
    /// The stiffnesses.
    pub parameters: Vec<ParameterReport>,
    /// Verdict on the fit.
    pub fit: Option<FitSummary>,
    /// Problems with the samples.
    pub samples: Option<Samples>,
}

/// Spectrum of a channel.
#[derive(Debug, Clone, Serialize)]
pub struct GroundSpectrum {
    /// Name of the channel.
    pub channel: String,
    /// Values over the period.
    pub values: Vec<SpectralValue>,
}

/// Everything that a report is made of.
pub struct Parts<'p> {
    pub structure: &'p Structure,
    pub record: &'p EventRecord,
    pub name: EventName,
    pub number: usize,
    pub settings: ReportSettings,
    pub windows: Vec<Window>,
    pub identified: Identified,
    pub no_responses: Option<&'static str>,
    pub parameters: Vec<ParameterReport>,
    pub open_alerts: Vec<String>,
}

impl EventReport {
    /// Puts the report together.
    ///
    /// # Errors
    /// Returns an error if a spectral value cannot be computed.
    pub fn new(parts: Parts<'_>) -> Result<Self, AppError> {
        let Parts {
            structure,
            record,
            name,
            number,
            settings,
            windows,
            identified,
            no_responses,
            parameters,
            open_alerts,
        } = parts;
        let figures = record.figures(structure)?;
        let health = record.health.iter().map(Option::as_ref);
        let sensors: Vec<SensorReport> = figures
            .into_iter()
            .zip(health)
            .map(|(figures, health)| SensorReport {
                figures,
                health: HealthReport::new(health),
            })
            .collect();
        let peak = windows.iter().map(|window| window.peak).fold(0.0, f64::max);
        let mut report = Self {
            kind: KIND,
            structure: structure.name().to_owned(),
            description: structure.description().to_owned(),
            name,
            number,
            sampling_rate_hz: structure.sampling_rate_hz(),
            length_s: record.length_s(structure.sampling_rate_hz()),
            fundamental_hz: fundamental_hz(structure),
            settings,
            urgency: Urgency::NoAction,
            rank: Urgency::NoAction.rank(),
            headline: String::new(),
            happened: Vec::new(),
            judged: Vec::new(),
            not_judged: Vec::new(),
            open_alerts,
            alerts: Vec::new(),
            peak_m_per_s2: peak,
            ground_spectra: ground_spectra(structure, record)?,
            sensors,
            responses: identified.responses,
            no_responses,
            windows,
            parameters,
            fit: identified.summary.fit,
            samples: identified.summary.samples,
        };
        // Strong motion softens a structure, so that a rule is no judgement of it.
        if !report.shook() {
            report.alerts = raised_at_end(&identified.summary.alerts);
        }
        report.urgency = report.judged_urgency();
        report.rank = report.urgency.rank();
        report.happened = wording::happened(&report);
        report.judged = wording::judged(&report);
        report.not_judged = wording::not_judged(&report);
        report.headline = wording::headline(&report);
        Ok(report)
    }

    /// Returns `true` if the record contains strong motion.
    pub fn shook(&self) -> bool {
        self.peak_m_per_s2 > self.settings.strong_above_m_per_s2
    }

    /// Returns the judged lasting loss that most probably exceeds the loss that matters, with the
    /// parameter and the event since which it lasts. A raised one goes first.
    pub fn worst_loss(&self) -> Option<(&ParameterReport, &EventName, LastingLoss)> {
        let each = self.parameters.iter().filter_map(|parameter| {
            let judgement = &parameter.judgement;
            let (since, loss) = judgement.raised().or_else(|| judgement.most_probable())?;
            Some((parameter, &parameter.events.get(since)?.name, loss))
        });
        each.max_by(|a, b| {
            let by_raised = a.2.is_raised.cmp(&b.2.is_raised);
            by_raised.then(a.2.probability.total_cmp(&b.2.probability))
        })
    }

    /// Returns the stiffnesses that decide: that of the whole structure if it can be fitted,
    /// otherwise those of all parameters.
    pub fn decisive(&self) -> impl Iterator<Item = &ParameterReport> {
        let is_whole = |parameter: &ParameterReport| parameter.source == Source::WholeStructure;
        let has_whole = self.parameters.iter().any(is_whole);
        let all = self.parameters.iter();
        all.filter(move |parameter| !has_whole || is_whole(parameter))
    }

    /// Returns `true` if a lasting loss since this event is judged.
    pub fn own_is_judged(&self) -> bool {
        let is_judged = |parameter: &ParameterReport| {
            let own = parameter.judgement.own();
            own.is_some_and(|own| own.loss.is_some())
        };
        !self.parameters.is_empty() && self.decisive().all(is_judged)
    }

    /// Returns the stiffness in weak motion that lies farthest outside the interval that the
    /// earlier events predict, with its interval. `None` if all lie inside, or if a lasting loss of
    /// this stiffness is probable: it compares more events.
    pub fn unpredicted(&self) -> Option<(&ParameterReport, f64, Interval)> {
        let each = self.parameters.iter().filter_map(|parameter| {
            let weak = parameter.judgement.weak?;
            let (stiffness, interval) = (weak.motion.y.exp(), weak.predicted?);
            let is_explained = parameter
                .judgement
                .most_probable()
                .is_some_and(|(_, loss)| loss.probability >= 0.5);
            let is_outside = !interval.contains(stiffness) && !is_explained;
            is_outside.then_some((parameter, stiffness, interval))
        });
        let distance = |(_, k, interval): &(&ParameterReport, f64, Interval)| {
            (interval.low / k).max(k / interval.high)
        };
        each.max_by(|a, b| distance(a).total_cmp(&distance(b)))
    }

    /// Returns `true` if the running services or this record have raised an alert.
    pub fn has_alert(&self) -> bool {
        !self.open_alerts.is_empty() || !self.alerts.is_empty()
    }

    fn judged_urgency(&self) -> Urgency {
        let is_beyond = self.decisive().any(|parameter| {
            let raised = parameter.judgement.softening.filter(|one| one.is_raised);
            let expected = raised.and_then(|softening| softening.expected);
            expected.is_some_and(|one| !one.is_as_expected && one.deviations < 0.0)
        });
        let worst = self.worst_loss().map(|(_, _, loss)| loss);
        if is_beyond || worst.is_some_and(|loss| loss.is_raised) {
            return Urgency::InspectFirst;
        }
        let is_unjudged = self.shook() && !self.own_is_judged();
        let is_changed = self.unpredicted().is_some() || self.has_alert();
        if is_unjudged || is_changed || worst.is_some_and(|loss| loss.probability >= 0.5) {
            return Urgency::Inspect;
        }
        let has_doubt = self
            .sensors
            .iter()
            .any(|sensor| sensor.health.is_suspected());
        if self.shook() || has_doubt {
            Urgency::Watch
        } else {
            Urgency::NoAction
        }
    }

    /// Returns the report as one JSON object.
    pub fn json(&self) -> String {
        // Cannot fail: the report has no map with keys other than strings.
        serde_json::to_string_pretty(self)
            .map_or_else(|error| error.to_string(), |text| text + "\n")
    }
}

/// Returns the sentences of the alerts that are still raised after the last change.
fn raised_at_end(alerts: &[AlertSummary]) -> Vec<String> {
    let is_last = |index: usize| {
        let later = &alerts[index + 1..];
        later
            .iter()
            .all(|other| other.parameter != alerts[index].parameter)
    };
    let raised = alerts
        .iter()
        .enumerate()
        .filter(|(index, alert)| alert.state != AlertState::Cleared && is_last(*index));
    raised.map(|(_, alert)| alert.why.clone()).collect()
}

fn ground_spectra(
    structure: &Structure,
    record: &EventRecord,
) -> Result<Vec<GroundSpectrum>, AppError> {
    let ratio = (SPECTRUM_TO_S / SPECTRUM_FROM_S).ln() / (SPECTRUM_PERIODS - 1) as f64;
    let periods: Vec<f64> = (0..SPECTRUM_PERIODS)
        .map(|index| SPECTRUM_FROM_S * (ratio * index as f64).exp())
        .collect();
    let channels = structure.channels().zip(&record.channels);
    channels
        .filter(|(channel, _)| {
            channel.quantity() == spandrel_structure::Quantity::GroundAcceleration
        })
        .map(|(channel, samples)| -> Result<GroundSpectrum, AppError> {
            Ok(GroundSpectrum {
                channel: channel.name().to_owned(),
                values: spectrum(samples, structure.step_s(), &periods)?,
            })
        })
        .collect()
}
