//! Settings for the tests, and what they read in the judgements.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::Rng;
use spandrel_judge::{
    Condition, ConditionKind, Epoch, Judge, Judgement, Quantity, QuantityKind, Season, Settings,
    State,
};

/// Settings of natural frequencies under temperatures in °C.
pub fn settings(quantities: &[&str], conditions: &[&str], commissioning_days: u32) -> Settings {
    Settings {
        false_alarms_per_year: 0.1,
        loss: Settings::LOSS,
        commissioning_days,
        season: Season::Required,
        quantities: quantities
            .iter()
            .map(|name| Quantity {
                name: (*name).to_owned(),
                kind: QuantityKind::Frequency,
                thermometers: Vec::new(),
            })
            .collect(),
        conditions: conditions
            .iter()
            .map(|name| Condition {
                name: (*name).to_owned(),
                kind: ConditionKind::Celsius,
            })
            .collect(),
    }
}

/// Returns the sum of twelve uniform numbers, less its mean. Its standard deviation is 1.
pub fn noise(random: &mut ChaCha8Rng) -> f64 {
    let uniform = |_| f64::from(random.next_u32()) / f64::from(u32::MAX);
    (0..12).map(uniform).sum::<f64>() - 6.0
}

/// Judges all epochs.
pub fn judge(settings: Settings, epochs: &[Epoch]) -> (Judge, Vec<Judgement>) {
    let mut judge = Judge::new(settings).unwrap();
    let mut judgements = Vec::new();
    for epoch in epochs {
        judge.handle(epoch, &mut judgements).unwrap();
    }
    judge.finish(&mut judgements);
    (judge, judgements)
}

/// Returns the first alarm.
pub fn first_alarm(judgements: &[Judgement]) -> Option<&Judgement> {
    judgements
        .iter()
        .find(|judgement| judgement.finding.is_some_and(|f| f.is_alarm()))
}

/// Returns the share of judged days within the 95 % interval.
pub fn coverage<'j>(judgements: impl Iterator<Item = &'j Judgement>) -> f64 {
    let (mut inside, mut all) = (0.0, 0.0);
    for judgement in judgements.filter(|judgement| judgement.state == State::Judged) {
        if let Some(expectation) = judgement.expectation {
            let [low, high] = expectation.interval;
            all += 1.0;
            inside += f64::from(u8::from((low..=high).contains(&expectation.measured)));
        }
    }
    inside / all
}

/// Prints what was judged, for a reader of a failed test.
pub fn describe(judge: &Judge, judgements: &[Judgement]) {
    for report in judge.report() {
        let name = &report.quantity;
        let of = || {
            judgements
                .iter()
                .filter(|judgement| &judgement.quantity == name)
        };
        let count = |is: fn(&State) -> bool| of().filter(|j| is(&j.state)).count();
        let evidence = of()
            .filter(|j| j.finding.is_none())
            .filter_map(|j| j.expectation);
        println!(
            "{name}: judged {}, outside {}, none {}, not ready {}, largest ln R {:.2}",
            count(|state| *state == State::Judged),
            count(|state| matches!(state, State::OutsideExperience { .. })),
            count(|state| matches!(state, State::NoStatement { .. })),
            count(|state| matches!(state, State::NotReady { .. })),
            evidence
                .map(|e| e.ln_evidence)
                .fold(f64::NEG_INFINITY, f64::max),
        );
        match (&report.reference, &report.missing) {
            (Some(r), _) => println!(
                "  σ {:.5} φ {} T0 {:?} coverage {:.3} ln threshold {:.2} achieved {:.4} delays \
                 {:?}",
                r.scatter,
                r.correlation,
                r.frost_knot,
                r.coverage,
                r.ln_threshold,
                r.performance.achieved_per_year,
                r.performance
                    .delays
                    .iter()
                    .map(|d| d.median_days)
                    .collect::<Vec<_>>()
            ),
            (None, missing) => println!("  missing: {missing:?}"),
        }
        for judgement in of().filter(|judgement| judgement.raised) {
            let kind = judgement.finding.map_or("", |finding| finding.name());
            println!("  day {} {kind}: {}", judgement.day, judgement.sentence());
        }
    }
}
