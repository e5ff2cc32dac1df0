//! `spandrel earthquake`: reports what earthquakes did to a structure, from recordings.

use super::{print, refuse_overwriting};
use crate::cli::EarthquakeArguments;
use crate::earthquake::event_record::{EventRecord, fundamental_hz};
use crate::earthquake::identified::{Identified, half_life_s, identify};
use crate::earthquake::report::{
    ComparedEvent, EventName, EventReport, ParameterReport, Parts, ReportSettings, Source,
};
use crate::earthquake::storeys::{WithDisplacements, with_displacements};
use crate::earthquake::{index, page, whole, wording};
use crate::error::AppError;
use spandrel_earthquake::{
    EventCourse, Interval, MeasuredMotion, Phase, PhaseSettings, Sequence, WeakMotion, Window,
    windows,
};
use spandrel_structure::Structure;
use std::path::Path;

/// Time for which the stiffness recovers after shaking (s). Concrete and soil regain most of it within
/// minutes.
const SETTLING_S: f64 = 300.0;
/// Half-lives of the filter after which strong motion is forgotten: its information is then 1/16.
const MEMORY_HALF_LIVES: f64 = 2.0;
/// Longest memory that is waited for (s), if the filter forgets slowly or not at all.
const LONGEST_MEMORY_S: f64 = 3600.0;
/// Two-sided 95 % of a normal distribution.
const TWO_SIDED_95: f64 = 1.96;
/// Name of the list of all reports.
const INDEX: &str = "index.html";

/// Reports each recording, in the order of time, and writes the ranked list.
///
/// # Errors
/// A file is not valid or cannot be written. The reports of all valid recordings are written before
/// the first recording that is not valid is reported as an error.
pub fn run(arguments: &EarthquakeArguments) -> Result<(), AppError> {
    let structure = Structure::read_with_model(&arguments.structure)?;
    let with = with_displacements(structure, &arguments.structure);
    let settings = ReportSettings {
        loss: arguments.loss,
        credibility: arguments.credibility,
        strong_above_m_per_s2: arguments.strong,
    };
    let mut records = Vec::new();
    let mut failed = Vec::new();
    for path in &arguments.records {
        match EventRecord::read(&with.structure, path) {
            Ok(record) => records.push(record),
            Err(error) => failed.push(error),
        }
    }
    match records.iter().find(|record| record.time_ns().is_none()) {
        None => records.sort_by_key(EventRecord::time_ns),
        // Nothing is known of where it belongs, so the order of the command line counts.
        Some(undated) => check_order(&records, undated)?,
    }
    let names: Vec<EventName> = records
        .iter()
        .map(|record| EventName::new(&with.structure, record))
        .collect();
    for (index, name) in names.iter().enumerate() {
        if let Some(first) = names[..index]
            .iter()
            .position(|one| one.event == name.event)
        {
            return Err(AppError::SameEvent {
                first: records[first].path.clone(),
                second: records[index].path.clone(),
                event: name.event.clone(),
            });
        }
        for extension in ["html", "json"] {
            let file = arguments.report.join(format!("{}.{extension}", name.event));
            refuse_overwriting(&file, arguments.records.iter().map(|path| path.as_path()))?;
        }
    }
    if records.is_empty() {
        return failed.into_iter().next().map_or(Ok(()), Err);
    }
    create(&arguments.report)?;
    let mut course = Course::new(&with, settings)?;
    for (record, name) in records.iter().zip(names) {
        let report = course.report(record, name)?;
        let file = |extension| {
            arguments
                .report
                .join(format!("{}.{extension}", report.name.event))
        };
        write(&file("html"), &page::html(&report, &record.channels))?;
        write(&file("json"), &report.json())?;
        print(&(wording::line(&report) + "\n"))?;
    }
    let entries = index::entries(&arguments.report)?;
    write(&arguments.report.join(INDEX), &index::html(&entries))?;
    match failed.len() {
        0 => Ok(()),
        count => Err(AppError::NotReported {
            count,
            reported: records.len(),
            source: Box::new(failed.swap_remove(0)),
        }),
    }
}

/// Checks that the recordings with dates are in the order of time.
fn check_order(records: &[EventRecord], undated: &EventRecord) -> Result<(), AppError> {
    let dated = records.iter().filter(|record| record.time_ns().is_some());
    let dated: Vec<&EventRecord> = dated.collect();
    let wrong = dated
        .windows(2)
        .find(|two| two[0].time_ns() > two[1].time_ns());
    wrong.map_or(Ok(()), |two| {
        Err(AppError::NotInOrder {
            first: two[0].path.clone(),
            later: two[0].date().unwrap_or_default(),
            second: two[1].path.clone(),
            earlier: two[1].date().unwrap_or_default(),
            undated: undated.path.clone(),
        })
    })
}

/// The events of a structure, one after the other.
struct Course<'s> {
    with: &'s WithDisplacements,
    settings: ReportSettings,
    settling_s: f64,
    /// Number of events so far.
    number: usize,
    /// Time at which the last shaking has settled (ns since 1970-01-01 UTC).
    settled_ns: Option<i64>,
    judged: Vec<Judged>,
}

/// One stiffness with its events.
struct Judged {
    name: String,
    source: Source,
    /// Index of the direction, or of the parameter in the structure.
    index: usize,
    sequence: Sequence,
    events: Vec<ComparedEvent>,
}

impl<'s> Course<'s> {
    fn new(with: &'s WithDisplacements, settings: ReportSettings) -> Result<Self, AppError> {
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
            with,
            settings,
            settling_s: memory_s.clamp(SETTLING_S, LONGEST_MEMORY_S),
            number: 0,
            settled_ns: None,
            judged,
        })
    }

    fn report(&mut self, record: &EventRecord, name: EventName) -> Result<EventReport, AppError> {
        self.number += 1;
        let structure = &self.with.structure;
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
        let identified = identify(self.with, record)?;
        let motions = whole::motions(structure, record)?;
        let parameters = self.judge(&windows, &identified, &motions, &name);
        EventReport::new(Parts {
            structure,
            record,
            name,
            number: self.number,
            settings: self.settings,
            windows,
            identified,
            no_responses: self.with.missing,
            parameters,
        })
    }

    fn judge(
        &mut self,
        windows: &[Window],
        identified: &Identified,
        motions: &[MeasuredMotion],
        name: &EventName,
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
            let judgement = sequence.push(course.clone());
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

fn create(folder: &Path) -> Result<(), AppError> {
    std::fs::create_dir_all(folder).map_err(|source| AppError::Io {
        what: format!("cannot create {}", folder.display()),
        source,
    })
}

fn write(path: &Path, text: &str) -> Result<(), AppError> {
    std::fs::write(path, text).map_err(|source| AppError::Io {
        what: format!("cannot write {}", path.display()),
        source,
    })
}
