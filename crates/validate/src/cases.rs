//! The validation cases, one per published example.

use crate::error::ValidateError;
use crate::fit;
use crate::judging;
use crate::modal;
use crate::outcome::Outcome;
use crate::robustness;
use crate::run::Run;
use std::sync::LazyLock;

mod asynchronous;
mod class_bouc_wen;
mod class_dome;
mod class_high_rise;
mod classes;
mod distributed;
mod ekf_bouc_wen;
mod ekf_bridge;
mod ekf_oscillator;
mod ekf_tower;
mod feedback;
mod hierarchical;
mod kalman_building;
mod kalman_vehicle;
mod noise_bouc_wen;
mod noise_bridge;
mod noise_chain;
mod noise_kalman;
mod outlier_oscillator;
mod outlier_truss;
mod particle;
mod pieces;

/// A published example.
#[derive(Debug)]
pub struct Case {
    /// Name of the form `group.example`.
    pub name: &'static str,
    /// One-line description.
    pub title: &'static str,
    /// Publication and section.
    pub source: &'static str,
    /// Relative computing time: roughly the seconds for one seed at full length.
    pub weight: f64,
    pub(crate) run: fn(&Run<'_>) -> Result<Outcome, ValidateError>,
}

impl Case {
    /// Returns `true` if the case reads records of real structures, which are not part of the
    /// project.
    #[must_use]
    pub fn needs_records(&self) -> bool {
        judging::REAL_CASES
            .iter()
            .any(|real| real.name == self.name)
    }
}

const BOOK_2: &str = "Huang & Yuen (2023), chapter 2";
const BOOK_3: &str = "Huang & Yuen (2023), chapter 3";
const YUEN_2013: &str = "Yuen, Liang & Kuok (2013)";
const BOOK_4: &str = "Huang & Yuen (2023), chapter 4";

const BOOK_5: &str = "Huang & Yuen (2023), chapter 5";

const BOOK_6: &str = "Huang & Yuen (2023), chapter 6";

const BOOK_7: &str = "Huang & Yuen (2023), chapter 7";

const CHING_2006: &str = "Ching, Beck, Porter & Shaikhutdinov (2006)";

static CASES: [Case; 29] = [
    Case {
        name: "kalman.vehicle",
        title: "Tracking of a vehicle with the Kalman filter",
        source: BOOK_2,
        weight: 0.01,
        run: kalman_vehicle::run,
    },
    Case {
        name: "kalman.building-60",
        title: "Responses of a sixty-storey building with the Kalman filter",
        source: BOOK_2,
        weight: 15.0,
        run: kalman_building::run,
    },
    Case {
        name: "ekf.oscillator",
        title: "Oscillator with unknown frequency and damping ratio, poor start",
        source: BOOK_2,
        weight: 0.2,
        run: ekf_oscillator::run,
    },
    Case {
        name: "ekf.bridge",
        title: "Three-pier bridge, two groups of members damaged",
        source: BOOK_2,
        weight: 200.0,
        run: ekf_bridge::run,
    },
    Case {
        name: "ekf.bouc-wen",
        title: "Ten-mass chain whose springs yield, two of them damaged",
        source: BOOK_2,
        weight: 30.0,
        run: ekf_bouc_wen::run,
    },
    Case {
        name: "ekf.tower",
        title: "Tower of 610 m, two stiffnesses from wrong starts (twelve beams in place of 37)",
        source: BOOK_2,
        weight: 300.0,
        run: ekf_tower::run,
    },
    Case {
        name: "noise-kalman.1",
        title: "Fifty-storey building, noise levels of the linear filter: ground motion",
        source: YUEN_2013,
        weight: 40.0,
        run: noise_kalman::ground,
    },
    Case {
        name: "noise-kalman.2",
        title: "Fifty-storey building, noise levels of the linear filter: modulated ground motion",
        source: YUEN_2013,
        weight: 60.0,
        run: noise_kalman::modulated_ground,
    },
    Case {
        name: "noise-kalman.3",
        title: "Fifty-storey building, noise levels of the linear filter: wind",
        source: YUEN_2013,
        weight: 40.0,
        run: noise_kalman::wind,
    },
    Case {
        name: "noise-ekf.chain",
        title: "Five-mass chain with wrong, right and identified noise levels",
        source: BOOK_3,
        weight: 4.0,
        run: noise_chain::run,
    },
    Case {
        name: "noise-ekf.bouc-wen.1",
        title: "Five-mass chain whose springs yield, noise levels identified: stationary noises",
        source: BOOK_3,
        weight: 12.0,
        run: noise_bouc_wen::stationary,
    },
    Case {
        name: "noise-ekf.bouc-wen.2",
        title: "Five-mass chain whose springs yield, noise levels identified: ground motion swells",
        source: BOOK_3,
        weight: 12.0,
        run: noise_bouc_wen::excitation_swells,
    },
    Case {
        name: "noise-ekf.bouc-wen.3",
        title: "Five-mass chain whose springs yield, noise levels identified: ground motion and \
                sensor noise swell",
        source: BOOK_3,
        weight: 12.0,
        run: noise_bouc_wen::both_swell,
    },
    Case {
        name: "noise-ekf.bridge.1",
        title: "Three-pier bridge, noise levels identified: horizontal ground motion swells",
        source: BOOK_3,
        weight: 250.0,
        run: noise_bridge::horizontal,
    },
    Case {
        name: "noise-ekf.bridge.2",
        title: "Three-pier bridge, noise levels identified: vertical ground motion swells",
        source: BOOK_3,
        weight: 500.0,
        run: noise_bridge::both,
    },
    Case {
        name: "outlier.oscillator",
        title: "Oscillator with one wrong sample in a hundred",
        source: BOOK_4,
        weight: 20.0,
        run: outlier_oscillator::run,
    },
    Case {
        name: "outlier.truss",
        title: "Fourteen-bay truss with wrong samples on all channels",
        source: BOOK_4,
        weight: 900.0,
        run: outlier_truss::run,
    },
    Case {
        name: "class.high-rise",
        title: "Fifty-storey building, five model classes with more and more of its storeys taken \
                singly",
        source: BOOK_5,
        weight: 100.0,
        run: class_high_rise::run,
    },
    Case {
        name: "class.bouc-wen",
        title: "Five-mass chain whose springs yield, six model classes that calibrate the model",
        source: BOOK_5,
        weight: 35.0,
        run: class_bouc_wen::run,
    },
    Case {
        name: "class.dome",
        title: "Dome of 42 bars, model classes for its substructures and then for their bars",
        source: BOOK_5,
        weight: 900.0,
        run: class_dome::run,
    },
    Case {
        name: "distributed.building",
        title: "Forty-storey building, sixteen nodes with their own filters",
        source: BOOK_6,
        weight: 600.0,
        run: distributed::building,
    },
    Case {
        name: "distributed.bridge",
        title: "Bridge with two piers, fifteen nodes with their own filters",
        source: BOOK_6,
        weight: 3000.0,
        run: distributed::bridge,
    },
    Case {
        name: "asynchronous.two-dof",
        title: "Two masses, one clock late: one filter, and a filter for each channel",
        source: BOOK_7,
        weight: 1.0,
        run: asynchronous::two_dof,
    },
    Case {
        name: "asynchronous.truss",
        title: "Sixteen-bay truss, ten nodes whose clocks disagree",
        source: BOOK_7,
        weight: 1300.0,
        run: asynchronous::truss,
    },
    Case {
        name: "asynchronous.feedback",
        title: "The same truss: what nodes send of the covariance, and what they do with the \
                answer",
        source: BOOK_7,
        weight: 600.0,
        run: feedback::truss,
    },
    Case {
        name: "hierarchical.building",
        title: "Forty-storey building with spikes in every channel and three biased nodes",
        source: BOOK_7,
        weight: 800.0,
        run: hierarchical::building,
    },
    Case {
        name: "hierarchical.pieces",
        title: "The same building, shortened, with a piece of the method left out",
        source: BOOK_7,
        weight: 100.0,
        run: pieces::building,
    },
    Case {
        name: "particle.building",
        title: "Four-storey building whose properties drift, followed by particles",
        source: CHING_2006,
        weight: 75.0,
        run: particle::drifting_building,
    },
    Case {
        name: "particle.hysteretic",
        title: "Hysteretic oscillator whose properties drift, followed by particles",
        source: CHING_2006,
        weight: 150.0,
        run: particle::hysteretic,
    },
];

/// Returns all cases.
///
/// The published ones come first, in the order of their sources. The cases of robustness, of the
/// example files, of lasting change and of natural frequencies follow.
#[must_use]
pub fn cases() -> &'static [&'static Case] {
    static ALL: LazyLock<Vec<&'static Case>> = LazyLock::new(|| {
        CASES
            .iter()
            .chain(robustness::CASES)
            .chain(fit::CASES)
            .chain(judging::CASES)
            .chain(judging::REAL_CASES)
            .chain(modal::CASES)
            .collect()
    });
    &ALL
}

/// Returns the cases with the given names.
///
/// A name also selects every case whose name begins with it and a full stop. An empty list selects
/// all cases.
///
/// # Errors
/// Returns an error if a name selects no case.
pub fn select(names: &[String]) -> Result<Vec<&'static Case>, ValidateError> {
    let stands_for = |name: &str, case: &Case| {
        case.name == name
            || case
                .name
                .strip_prefix(name)
                .is_some_and(|rest| rest.starts_with('.'))
    };
    if let Some(found) = names
        .iter()
        .find(|name| !cases().iter().any(|case| stands_for(name, case)))
    {
        let known: Vec<&str> = cases().iter().map(|case| case.name).collect();
        return Err(ValidateError::UnknownCase {
            found: found.clone(),
            known: known.join(", "),
        });
    }
    Ok(cases()
        .iter()
        .copied()
        .filter(|case| names.is_empty() || names.iter().any(|name| stands_for(name, case)))
        .collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_select_cases_and_groups() {
        let names = |names: &[&str]| -> Vec<&str> {
            let names: Vec<String> = names.iter().map(|&name| name.to_owned()).collect();
            select(&names)
                .unwrap()
                .iter()
                .map(|case| case.name)
                .collect()
        };
        assert_eq!(names(&[]).len(), cases().len());
        assert_eq!(names(&["kalman.vehicle"]), ["kalman.vehicle"]);
        assert_eq!(names(&["kalman"]), ["kalman.vehicle", "kalman.building-60"]);
        let error = select(&["kalma".to_owned()]).unwrap_err().to_string();
        assert!(
            error.contains("unknown case kalma,") && error.contains("kalman.vehicle"),
            "{error}"
        );
    }
}
