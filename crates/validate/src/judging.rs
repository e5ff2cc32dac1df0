//! Lasting change: simulated structures over years, and what `spandrel-judge` says about them.
//!
//! A run simulates many structures, each in its own climate. The simulation shares no equation with
//! the judgement. A structure that is not ready counts as sound years without an alarm, and as a
//! loss that is not judged.
//!
//! `series` and `overpass` judge real structures. `footbridge` is the simulated series of the
//! documentation, which no case judges.

mod bridge;
mod footbridge;
mod overpass;
mod series;

pub use footbridge::{SeasonRow, StiffnessLoss, seasons, seasons_csv};
pub(crate) use series::CASES as REAL_CASES;

use crate::cases::Case;
use crate::error::ValidateError;
use crate::figure::{Figure, Required};
use crate::outcome::Outcome;
use crate::run::{Length, Run};
use bridge::{Loss, Site, Wanted, epochs};
use spandrel_judge::{
    Condition, ConditionKind, Epoch, Judge, Judgement, Quantity, QuantityKind, Season, Settings,
    State,
};

const SOURCE: &str = "Lasting change, simulated";
/// Epochs per day of the simulated structures.
const PER_DAY: u32 = 4;
/// Budget of the structures (false alarms per year).
const BUDGET: f64 = 0.1;
/// Largest allowed rate of false alarms, relative to the budget.
const LARGEST_RATE: f64 = 1.5;
/// Days that are judged after the commissioning.
const JUDGED_DAYS: u32 = 365;
/// Losses of stiffness.
const LOSSES: [f64; 4] = [0.02, 0.03, 0.05, 0.10];
/// Earliest day of a loss after the commissioning, and range of the days after it.
const FIRST_LOSS_DAY: u32 = 60;
const LOSS_DAYS: u64 = 200;

pub(crate) static CASES: &[Case] = &[
    Case {
        name: "judge.sound-years",
        title: "Sound structures, judged for a year after a commissioning of a year",
        source: SOURCE,
        weight: 200.0,
        run: |run| sound(run, Site::Slender, 365, run.pick(1000, 8)),
    },
    Case {
        name: "judge.sound-years-120",
        title: "Sound structures, judged for a year after a commissioning of 120 days in any \
                season",
        source: SOURCE,
        weight: 60.0,
        run: |run| sound(run, Site::Slender, 120, run.pick(400, 8)),
    },
    Case {
        name: "judge.sound-years-massive",
        title: "Sound massive structures with a thermometer in the air, commissioning of a year",
        source: SOURCE,
        weight: 80.0,
        run: |run| sound(run, Site::Massive, 365, run.pick(400, 8)),
    },
    Case {
        name: "judge.losses",
        title: "A sudden loss of stiffness of one mode, in any season",
        source: SOURCE,
        weight: 60.0,
        run: |run| losses(run, Site::Slender),
    },
    Case {
        name: "judge.losses-massive",
        title: "The same of massive structures with a thermometer in the air",
        source: SOURCE,
        weight: 60.0,
        run: |run| losses(run, Site::Massive),
    },
];

/// Returns the share that a process with a memory of `days` keeps from one epoch to the next.
fn kept(days: f64) -> f64 {
    (-1.0 / (days * f64::from(PER_DAY))).exp()
}

/// Judges the simulated structure of a seed.
fn judge(seed: u64, wanted: Wanted) -> Result<(Judge, Vec<Judgement>), ValidateError> {
    let modes = &["mode-1", "mode-2"][..wanted.modes];
    let settings = settings(modes, &["temperature"], wanted.days - JUDGED_DAYS);
    judged(settings, &epochs(seed, wanted))
}

/// Returns the settings of natural frequencies under temperatures (°C).
fn settings(modes: &[&str], temperatures: &[&str], commissioning_days: u32) -> Settings {
    let quantity = |name: &&str| Quantity {
        name: (*name).to_owned(),
        kind: QuantityKind::Frequency,
        thermometers: Vec::new(),
    };
    let condition = |name: &&str| Condition {
        name: (*name).to_owned(),
        kind: ConditionKind::Celsius,
    };
    Settings {
        false_alarms_per_year: BUDGET,
        loss: Settings::LOSS,
        commissioning_days,
        season: Season::Required,
        quantities: modes.iter().map(quantity).collect(),
        conditions: temperatures.iter().map(condition).collect(),
    }
}

/// Judges all epochs.
fn judged(settings: Settings, epochs: &[Epoch]) -> Result<(Judge, Vec<Judgement>), ValidateError> {
    let mut judge = Judge::new(settings)?;
    let mut judgements = Vec::new();
    for epoch in epochs {
        judge.handle(epoch, &mut judgements)?;
    }
    judge.finish(&mut judgements);
    Ok((judge, judgements))
}

/// Returns `true` on the day on which an alarm is raised.
fn raises_alarm(judgement: &Judgement) -> bool {
    judgement.raised && judgement.finding.is_some_and(|finding| finding.is_alarm())
}

/// Returns whether the value of a judged day is in its 95 % interval. `None` if the day was not
/// judged.
fn is_inside(judgement: &Judgement) -> Option<bool> {
    let judged = judgement.state == State::Judged;
    let expectation = judgement.expectation.filter(|_| judged)?;
    let [low, high] = expectation.interval;
    Some((low..=high).contains(&expectation.measured))
}

/// Returns the seed of a structure of a run, and the day of the year on which its series begins.
fn structure(run: &Run<'_>, index: u64) -> (u64, f64) {
    let seed = 1_000_000 * run.seed + index;
    (seed, (seed * 97 % 365) as f64)
}

/// Counts over the judged days of sound structures.
#[derive(Debug, Default)]
struct Counts {
    alarms: f64,
    notices: f64,
    days: f64,
    judged: f64,
    outside: f64,
    inside: f64,
}

impl Counts {
    fn take(&mut self, judgements: &[Judgement]) {
        let raised = |alarm: bool| {
            let is = |judgement: &Judgement| {
                let finding = judgement.finding.filter(|_| judgement.raised);
                finding.is_some_and(|finding| finding.is_alarm() == alarm)
            };
            f64::from(u8::from(judgements.iter().any(is)))
        };
        self.alarms += raised(true);
        self.notices += raised(false);
        for judgement in judgements {
            let commissioning = matches!(judgement.state, State::Learning { .. });
            self.days += f64::from(u8::from(!commissioning));
            let outside = matches!(judgement.state, State::OutsideExperience { .. });
            self.outside += f64::from(u8::from(outside));
            if let Some(inside) = is_inside(judgement) {
                self.judged += 1.0;
                self.inside += f64::from(u8::from(inside));
            }
        }
    }
}

fn sound(
    run: &Run<'_>,
    site: Site,
    commissioning: u32,
    structures: u64,
) -> Result<Outcome, ValidateError> {
    let mut counts = Counts::default();
    for index in 0..structures {
        if !run.advance(index as f64 / structures as f64) {
            return Err(ValidateError::Stopped);
        }
        let (seed, first_day) = structure(run, index);
        let wanted = Wanted {
            modes: 2,
            days: commissioning + JUDGED_DAYS,
            first_day,
            loss: None,
            site,
        };
        counts.take(&judge(seed, wanted)?.1);
    }
    let years = structures as f64;
    let full = |required: Required| match run.length {
        Length::Full => required,
        Length::Quick => Required::Reported,
    };
    let coverage = Required::Between {
        low: 0.93,
        high: 0.97,
    };
    let inside = Figure::new(
        "share of judged days in the 95 % interval",
        counts.inside / counts.judged,
        full(coverage),
    );
    let figures = vec![
        Figure::new("simulated years", years, Required::Reported),
        Figure::new(
            "false alarms per year, over the budget",
            counts.alarms / years / BUDGET,
            full(Required::AtMost(LARGEST_RATE)),
        ),
        inside,
        Figure::new(
            "notices of a gain per year",
            counts.notices / years,
            Required::Reported,
        ),
        Figure::new(
            "share of days judged",
            counts.judged / counts.days,
            Required::Reported,
        ),
        Figure::new(
            "share of days outside experience",
            counts.outside / counts.days,
            Required::Reported,
        ),
    ];
    Ok(Outcome {
        figures,
        ..Outcome::default()
    })
}

/// Finds losses of every size, on the same structures.
fn losses(run: &Run<'_>, site: Site) -> Result<Outcome, ValidateError> {
    let structures = run.pick(100, 4);
    let all = (LOSSES.len() as u64 * structures) as f64;
    let mut figures = Vec::new();
    for (place, share) in LOSSES.into_iter().enumerate() {
        let mut delays = Vec::new();
        for index in 0..structures {
            let done = (place as u64 * structures + index) as f64;
            if !run.advance(done / all) {
                return Err(ValidateError::Stopped);
            }
            let (seed, first_day) = structure(run, index);
            let day = 365 + FIRST_LOSS_DAY + (seed * 37 % LOSS_DAYS) as u32;
            delays.extend(delay(seed, site, first_day, Loss { share, day })?);
        }
        let found = delays.iter().flatten().count() as f64;
        delays.sort_by_key(|delay| delay.unwrap_or(i64::MAX));
        let median = delays.get(delays.len() / 2).copied().flatten();
        let percent = 100.0 * share;
        figures.extend([
            Figure::new(
                format!("loss of {percent:.0} %: median delay (days)"),
                median.map_or(f64::NAN, |days| days as f64),
                Required::Reported,
            ),
            Figure::new(
                format!("loss of {percent:.0} %: share found within the year"),
                found / delays.len() as f64,
                Required::Reported,
            ),
        ]);
    }
    Ok(Outcome {
        figures,
        ..Outcome::default()
    })
}

/// Returns the days from a loss to its alarm, `Some(None)` if it is never raised, and `None` if the
/// loss cannot be judged: the reference was not ready, or a false alarm came before.
fn delay(
    seed: u64,
    site: Site,
    first_day: f64,
    loss: Loss,
) -> Result<Option<Option<i64>>, ValidateError> {
    let wanted = Wanted {
        modes: 1,
        days: 365 + JUDGED_DAYS,
        first_day,
        loss: Some(loss),
        site,
    };
    let (judge, judgements) = judge(seed, wanted)?;
    let day = i64::from(loss.day);
    let report = judge.report();
    let reference = report.first().and_then(|report| report.reference.as_ref());
    if reference.is_none_or(|reference| reference.to_day >= day) {
        return Ok(None);
    }
    let alarm = judgements.iter().find(|judgement| raises_alarm(judgement));
    Ok(match alarm.map(|alarm| alarm.day - day + 1) {
        Some(days) if days <= 0 => None,
        found => Some(found),
    })
}
