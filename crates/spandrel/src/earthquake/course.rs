//! The events of a structure in the order of time, each judged by the earlier ones.

use super::event_record::{EventRecord, fundamental_hz};
use super::identified::{Identified, half_life_s, identify};
use super::report::{
    ComparedEvent, EventName, EventReport, ParameterReport, Parts, ReportSettings, Source,
};
use super::storeys::WithDisplacements;
use super::whole;
use crate::error::AppError;
use spandrel_earthquake::{
    EventCourse, Interval, MeasuredMotion, Phase, PhaseSettings, Sequence, WeakMotion, Window,
    windows,
};
use std::sync::Arc;

/// Time for which the stiffness recovers after shaking (s). Concrete and soil regain most of it
/// within minutes.
const SETTLING_S: f64 = 300.0;
/// Half-lives of the filter after which strong motion is forgotten: its information is then 1/16.
const MEMORY_HALF_LIVES: f64 = 2.0;
/// Longest memory that is waited for (s), if the filter forgets slowly or not at all.
const LONGEST_MEMORY_S: f64 = 3600.0;
/// Two-sided 95 % of a normal distribution.
pub const TWO_SIDED_95: f64 = 1.96;
/// The events of a structure, one after the other.
#[derive(Debug)]
pub struct Course {
    with: Arc<WithDisplacements>,
    settings: ReportSettings,
    settling_s: f64,
    /// Number of events so far.
    number: usize,
    /// Time at which the last shaking has settled (ns since 1970-01-01 UTC).
    settled_ns: Option<i64>,
    judged: Vec<Judged>,
}

/// One stiffness with its events.
#[derive(Debug)]
struct Judged {
    name: String,
    source: Source,
    /// Index of the direction, or of the parameter in the structure.
    index: usize,
    sequence: Sequence,
    events: Vec<ComparedEvent>,
}

impl Course {
    /// Begins with the first event of a structure.
    ///
    /// # Errors
    /// Returns an error if a setting is out of range.
    pub fn new(with: WithDisplacements, settings: ReportSettings) -> Result<Self, AppError> {
        let whole = whole::names(&with.structure).into_iter().enumerate();
        let whole = whole.map(|(index, name)| (Source::WholeStructure, index, name));
        let parameters = with.structure.parameters().iter().enumerate();
        let parameters = parameters
            .filter(|(_, parameter)| parameter.is_stiffness())
            .map(|(index, parameter)| (Source::Parameter, index, parameter.name().to_owned()));
        let judged = whole
            .chain(parameters)
            .map(|(source, index, name)| -> Result<Judged, AppError> {
                Ok(Judged {
                    name,
                    source,
                    index,
                    sequence: Sequence::new(settings.judge())?,
                    events: Vec::new(),
                })
            })
            .collect::<Result<_, AppError>>()?;
        let memory_s = MEMORY_HALF_LIVES * half_life_s(&with.structure);
        Ok(Self {
            with: Arc::new(with),
            settings,
            settling_s: memory_s.clamp(SETTLING_S, LONGEST_MEMORY_S),
            number: 0,
            settled_ns: None,
            judged,
        })
    }

    /// Reports a recording that is later than all others. `standing` are the open alerts of the
    /// running services, in words.
    ///
    /// # Errors
    /// Returns an error if the recording cannot be identified.
    pub fn report(
        &mut self,
        record: &EventRecord,
        name: EventName,
        standing: &[String],
    ) -> Result<EventReport, AppError> {
        self.number += 1;
        let with = self.with.clone();
        let structure = &with.structure;
        let times = self.settled_ns.zip(record.time_ns());
        let unsettled_s =
            times.map(|(settled_ns, time_ns)| settled_ns.saturating_sub(time_ns) as f64 * 1e-9);
        let phases = PhaseSettings {
            rate_hz: structure.sampling_rate_hz(),
            fundamental_hz: fundamental_hz(structure),
            weak_peak: self.settings.strong_above_m_per_s2,
            settling_s: self.settling_s,
            unsettled_s: unsettled_s.unwrap_or(0.0),
        };
        let windows = windows(&record.amplitude_channels(structure)?, &phases)?;
        let shaking = windows
            .iter()
            .rfind(|window| window.phase == Phase::Shaking);
        if let (Some(last), Some(time_ns)) = (shaking, record.time_ns()) {
            let after_ns = ((last.end_s + self.settling_s) * 1e9) as i64;
            self.settled_ns = Some(time_ns.saturating_add(after_ns));
        }
        let identified = identify(&with, record)?;
        let motions = whole::motions(structure, record)?;
        let parameters = self.judge(&windows, &identified, &motions, &name, record.time_ns());
        EventReport::new(Parts {
            structure,
            record,
            name,
            number: self.number,
            settings: self.settings,
            windows,
            identified,
            no_responses: with.missing,
            parameters,
            open_alerts: standing.to_vec(),
        })
    }

    fn judge(
        &mut self,
        windows: &[Window],
        identified: &Identified,
        motions: &[MeasuredMotion],
        name: &EventName,
        time_ns: Option<i64>,
    ) -> Vec<ParameterReport> {
        let each = self.judged.iter_mut().map(|judged| {
            let Judged {
                sequence, events, ..
            } = judged;
            let course = match judged.source {
                Source::WholeStructure => {
                    let points = motions[judged.index].equivalent_stiffness(windows);
                    EventCourse::of_separate_windows(windows, points)
                }
                Source::Parameter => EventCourse::new(windows, &identified.estimates[judged.index]),
            };
            events.push(ComparedEvent {
                name: name.clone(),
                stiffness: course.weak().map(|weak| weak.y.exp()),
                within: course.weak().map(|weak| interval(&weak)),
                softest: course.softest().map(|point| point.y.exp()),
            });
            let expected = sequence.expected();
            let judgement = sequence.push(course.clone(), time_ns);
            ParameterReport {
                name: judged.name.clone(),
                source: judged.source,
                course,
                judgement,
                events: events.clone(),
                expected: expected.map(|interval| interval.map(f64::exp)),
                coverage: sequence.coverage(0..events.len()),
            }
        });
        each.collect()
    }
}

fn interval(weak: &WeakMotion) -> Interval {
    Interval {
        low: (weak.y - TWO_SIDED_95 * weak.s).exp(),
        high: (weak.y + TWO_SIDED_95 * weak.s).exp(),
    }
}
