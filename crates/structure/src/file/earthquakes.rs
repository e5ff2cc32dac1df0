//! Reads `[earthquakes]`.

use super::node::{ChannelRead, NodesRead};
use crate::earthquake_plan::EarthquakePlan;
use crate::node::Quantity;
use crate::section::{Allowed, Section};

/// Range of `earthquakes.keep`. Judging a loss needs at least four earlier events.
const KEEP_RANGE: (usize, usize) = (10, 1000);
/// Maximum number of further reports of an earthquake.
const MOST_REPORTS: usize = 8;
/// Latest further report (s): a year. Earliest: the structure settles for five minutes.
const AGAIN_RANGE_S: (f64, f64) = (60.0, 31_557_600.0);

/// Reads `[earthquakes]`; without the table no earthquake is reported.
pub(super) fn read_earthquakes(
    section: Option<Section<'_>>,
    nodes: &NodesRead,
) -> Option<EarthquakePlan> {
    let mut section = section?;
    let strong_m_per_s2 = section.number_or(
        "strong-m-per-s2",
        Allowed::POSITIVE,
        EarthquakePlan::STRONG_M_PER_S2,
    );
    let trigger_m_per_s2 =
        section.number_or("trigger-m-per-s2", Allowed::POSITIVE, strong_m_per_s2);
    if trigger_m_per_s2 > strong_m_per_s2 {
        section.diagnostics().report(
            section.span_of("trigger-m-per-s2"),
            section.key("trigger-m-per-s2"),
            format!("is {trigger_m_per_s2}"),
            format!("must be at most strong-m-per-s2, which is {strong_m_per_s2}"),
        );
    }
    let loss = section.number_or("loss", Allowed::INSIDE_UNIT, EarthquakePlan::LOSS);
    let credibility = section.number_or(
        "credibility",
        Allowed::INSIDE_UNIT,
        EarthquakePlan::CREDIBILITY,
    );
    let (least, most) = KEEP_RANGE;
    let keep = section
        .whole("keep", least, most)
        .map_or(EarthquakePlan::KEEP, toml::Spanned::into_inner);
    let again_after_s = read_again(&mut section);
    let channels = watched(&nodes.channels);
    if channels.is_empty() && !nodes.incomplete {
        section.diagnostics().report(
            section.span(),
            "earthquakes",
            "has no accelerometer",
            "must have a channel that measures an acceleration",
        );
    }
    section.finish();
    Some(EarthquakePlan {
        channels,
        trigger_m_per_s2,
        strong_m_per_s2,
        loss,
        credibility,
        again_after_s: again_after_s?,
        keep,
    })
}

/// Reads the times of further reports.
fn read_again(section: &mut Section<'_>) -> Option<Vec<f64>> {
    let Some(numbers) = section.numbers("again-after-s", Allowed::POSITIVE) else {
        let is_valid = !section.contains("again-after-s");
        return is_valid.then(|| EarthquakePlan::AGAIN_AFTER_S.to_vec());
    };
    let (shortest, longest) = AGAIN_RANGE_S;
    let times = numbers.get_ref();
    let is_in_range = times.iter().all(|time| (shortest..=longest).contains(time));
    let increases = times.windows(2).all(|two| two[0] < two[1]);
    if is_in_range && increases && times.len() <= MOST_REPORTS {
        return Some(times.clone());
    }
    let shown: Vec<String> = times.iter().map(f64::to_string).collect();
    section.diagnostics().report(
        numbers.span(),
        section.key("again-after-s"),
        format!("is [{}]", shown.join(", ")),
        format!(
            "must be at most {MOST_REPORTS} times from {shortest} to {longest} s in increasing \
             order"
        ),
    );
    None
}

/// Returns the channels that distinguish weak from strong motion: accelerations of the structure,
/// or else of its ground.
fn watched(channels: &[ChannelRead]) -> Vec<usize> {
    let accelerations = |is_excitation: bool| -> Vec<usize> {
        let quantities = channels.iter().map(|read| read.channel.quantity());
        let all = quantities.enumerate();
        all.filter(|(_, quantity)| {
            is_acceleration(*quantity) && quantity.is_excitation() == is_excitation
        })
        .map(|(index, _)| index)
        .collect()
    };
    let of_structure = accelerations(false);
    match of_structure.is_empty() {
        false => of_structure,
        true => accelerations(true),
    }
}

fn is_acceleration(quantity: Quantity) -> bool {
    match quantity {
        Quantity::AbsoluteAcceleration
        | Quantity::RelativeAcceleration
        | Quantity::RestoringAcceleration
        | Quantity::GroundAcceleration => true,
        Quantity::Force | Quantity::Velocity | Quantity::Displacement | Quantity::Strain => false,
    }
}

#[cfg(test)]
mod tests {
    use crate::EarthquakePlan;
    use crate::file::tests::{DEMO, mistakes, read};

    fn plan(table: &str) -> EarthquakePlan {
        let structure = read(&format!("{DEMO}\n[earthquakes]\n{table}")).unwrap();
        structure.earthquakes().unwrap().clone()
    }

    #[test]
    fn empty_table_has_the_limits_of_the_offline_command() {
        let plan = plan("");
        assert_eq!((plan.trigger_m_per_s2, plan.strong_m_per_s2), (1.0, 1.0));
        assert_eq!((plan.loss, plan.credibility), (0.05, 0.99));
        assert_eq!(plan.again_after_s, [300.0, 3600.0, 86_400.0, 604_800.0]);
        assert!(!plan.channels.is_empty());
        assert!(read(DEMO).unwrap().earthquakes().is_none());
    }

    #[test]
    fn trigger_follows_the_limit_of_weak_motion() {
        assert_eq!(plan("strong-m-per-s2 = 0.5").trigger_m_per_s2, 0.5);
        let plan = plan("strong-m-per-s2 = 0.5\ntrigger-m-per-s2 = 0.1\nagain-after-s = []");
        assert_eq!(plan.trigger_m_per_s2, 0.1);
        assert!(plan.again_after_s.is_empty());
    }

    #[test]
    fn mistakes_of_the_table_are_named() {
        let text = format!(
            "{DEMO}\n[earthquakes]\ntrigger-m-per-s2 = 2.0\nkeep = 3\n\
             again-after-s = [3600.0, 600.0]\ncolour = \"red\"\n"
        );
        let found = mistakes(&text);
        let expected = [
            "earthquakes.trigger-m-per-s2: is 2, must be at most strong-m-per-s2, which is 1",
            "earthquakes.keep: is 3, must",
            "earthquakes.again-after-s: is [3600, 600], must be at most 8 times",
            "earthquakes.colour: is not a known key",
        ];
        for start in expected {
            assert!(
                found.iter().any(|told| told.starts_with(start)),
                "{start}\n{found:#?}"
            );
        }
    }

    #[test]
    fn earthquakes_leave_the_basis_of_the_identification() {
        let with = format!("{DEMO}\n[earthquakes]\nkeep = 20\n");
        assert_eq!(
            read(&with).unwrap().identification_basis(),
            read(DEMO).unwrap().identification_basis()
        );
    }
}
