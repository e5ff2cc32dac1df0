//! The choice of the model: T0, r0, the memories, the scatters and the degrees of freedom.

use crate::amplitude::HINGES;
use crate::day::Day;
use crate::frost::{FREEZING, KNOTS, ln_prior};
use crate::inertia::{INERTIAS, Past};
use crate::model::{Columns, DEVIATIONS, MEMORIES, OFFSETS, Row, Structure, ZONE_SCATTERS};
use crate::regression::{Series, Taught};

/// Candidates of the degrees of freedom ν of the errors of a day. The last one is nearly normal.
/// It is also that of the choice of T0: heavy tails would explain a frost as many outliers.
const FREEDOMS: [f64; 3] = [4.0, 8.0, NEARLY_NORMAL];
const NEARLY_NORMAL: f64 = 50.0;
/// Smallest number of days in the frost zone from which its scatter can be learnt.
const FROST_ROWS: usize = 5;

/// The structure of the model with the largest evidence (profile likelihood with the prior of T0).
pub(crate) struct Choice {
    pub(crate) columns: Columns,
    pub(crate) structure: Structure,
    pub(crate) rows: Vec<Row>,
    /// The interior on the last day.
    pub(crate) past: Past,
    pub(crate) taught: Taught,
}

impl Choice {
    /// Chooses one property after the other, twice, and ν at the end.
    pub(crate) fn best(columns: Columns, days: &[Day], centre: f64) -> Self {
        let first = Structure {
            knot: FREEZING,
            offset: OFFSETS[OFFSETS.len() - 1],
            zone_scatter: ZONE_SCATTERS[ZONE_SCATTERS.len() - 1],
            inertia_days: INERTIAS[0],
            memory_days: MEMORIES[0],
            deviation: DEVIATIONS[1],
            freedom: NEARLY_NORMAL,
            usual_epochs: usual_epochs(days),
            hinge: 0,
        };
        let mut search = Search {
            days,
            centre,
            best: first,
            rows: columns.rows(days, &first, centre).0,
            columns,
            score: f64::NEG_INFINITY,
            sigma: None,
        };
        let in_zone = |row: &&Row| search.columns.zone(row) > 0.0;
        let frosty = search.rows.iter().filter(in_zone).count() >= FROST_ROWS;
        for _ in 0..2 {
            for memory in MEMORIES {
                for deviation in DEVIATIONS {
                    search.try_out(|structure| {
                        structure.memory_days = memory;
                        structure.deviation = deviation;
                    });
                }
            }
            if !search.columns.amplitudes.is_empty() {
                for hinge in 0..HINGES {
                    search.try_out(|structure| structure.hinge = hinge);
                }
            }
            if !frosty {
                for inertia in INERTIAS {
                    search.try_out(|structure| structure.inertia_days = inertia);
                }
                continue;
            }
            for offset in OFFSETS {
                for scatter in ZONE_SCATTERS {
                    search.try_out(|structure| {
                        structure.offset = offset;
                        structure.zone_scatter = scatter;
                    });
                }
            }
            for inertia in INERTIAS {
                for knot in 0..KNOTS.len() {
                    search.try_out(|structure| {
                        structure.inertia_days = inertia;
                        structure.knot = knot;
                    });
                }
            }
        }
        for freedom in FREEDOMS {
            search.try_out(|structure| structure.freedom = freedom);
        }
        let (rows, past) = search.columns.rows(days, &search.best, centre);
        let taught = search.fit(&search.best, &rows);
        Self {
            columns: search.columns,
            structure: search.best,
            rows,
            past,
            taught,
        }
    }
}

/// Returns the median number of epochs of a day.
fn usual_epochs(days: &[Day]) -> f64 {
    let mut epochs: Vec<u16> = days.iter().map(|day| day.epochs).collect();
    epochs.sort_unstable();
    f64::from(epochs.get(epochs.len() / 2).copied().unwrap_or(1))
}

/// A search for the best structure.
struct Search<'d> {
    days: &'d [Day],
    centre: f64,
    columns: Columns,
    best: Structure,
    rows: Vec<Row>,
    score: f64,
    sigma: Option<f64>,
}

impl Search<'_> {
    fn try_out(&mut self, change: impl Fn(&mut Structure)) {
        let mut structure = self.best;
        change(&mut structure);
        let same_rows = structure.knot == self.best.knot
            && structure.inertia_days == self.best.inertia_days
            && structure.hinge == self.best.hinge;
        let other_rows =
            (!same_rows).then(|| self.columns.rows(self.days, &structure, self.centre).0);
        let taught = self.fit(&structure, other_rows.as_ref().unwrap_or(&self.rows));
        let score = taught.ln_evidence + ln_prior(KNOTS[structure.knot]);
        if score > self.score {
            self.score = score;
            self.best = structure;
            self.sigma = Some(taught.posterior.sigma);
            self.rows = other_rows.unwrap_or_else(|| std::mem::take(&mut self.rows));
        }
    }

    fn fit(&self, structure: &Structure, rows: &[Row]) -> Taught {
        let series = Series {
            columns: &self.columns,
            structure,
            days: self.days,
            rows,
        };
        series.fit(self.sigma.unwrap_or_else(|| series.scatter()))
    }
}
