//! Reads `[[condition]]`: slow quantities such as temperatures.

use super::check_unique;
use crate::condition::Condition;
use crate::section::{Allowed, Section};
use toml::Spanned;

/// Reads every `[[condition]]`.
pub(super) fn read_conditions(file: &mut Section<'_>) -> Vec<Condition> {
    let read: Vec<_> = file
        .tables("condition")
        .into_iter()
        .filter_map(read_condition)
        .collect();
    let names: Vec<_> = read.iter().map(|(name, _)| name.clone()).collect();
    check_unique(file, "condition.name", &names);
    read.into_iter().map(|(_, condition)| condition).collect()
}

fn read_condition(mut section: Section<'_>) -> Option<(Spanned<String>, Condition)> {
    let name = section.required_name("name");
    let words = Condition::UNITS.map(|unit| (unit, unit));
    let unit = section.required_choice("unit", &words);
    let range = read_range(&mut section);
    let interval_s = section.number("interval-s", Allowed::POSITIVE);
    section.finish();
    let name = name?;
    let condition = Condition {
        name: name.get_ref().clone(),
        unit: unit?.into_inner(),
        range,
        interval_s: interval_s.map(Spanned::into_inner),
    };
    Some((name, condition))
}

/// Reads the plausible range: the lowest and the highest value.
fn read_range(section: &mut Section<'_>) -> Option<(f64, f64)> {
    let numbers = section.numbers("range", Allowed::ANY)?;
    match numbers.get_ref()[..] {
        [low, high] if low < high => Some((low, high)),
        _ => {
            let shown: Vec<String> = numbers.get_ref().iter().map(f64::to_string).collect();
            section.diagnostics().report(
                numbers.span(),
                section.key("range"),
                format!("is [{}]", shown.join(", ")),
                "must be the lowest and the highest plausible value, such as [-40, 60]",
            );
            None
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::file::tests::{DEMO, mistakes, read};

    #[test]
    fn condition_has_the_unit_range_and_interval_of_the_file() {
        let text = format!(
            "{DEMO}\n[[condition]]\nname = \"deck-temperature\"\nunit = \"degC\"\n\
             range = [-40, 60]\n\
             interval-s = 600\n[[condition]]\nname = \"wind\"\nunit = \"m/s\"\n"
        );
        let structure = read(&text).unwrap();
        let [deck, wind] = structure.conditions() else {
            panic!("two conditions: {:?}", structure.conditions());
        };
        assert_eq!((deck.name(), deck.unit()), ("deck-temperature", "degC"));
        assert_eq!(deck.interval_s(), Some(600.0));
        assert!(deck.is_plausible(-40.0) && !deck.is_plausible(60.1));
        assert_eq!((wind.range(), wind.interval_s()), (None, None));
        assert!(wind.is_plausible(1e9));
    }

    #[test]
    fn mistakes_of_a_condition_are_named() {
        let text = format!(
            "{DEMO}\n[[condition]]\nname = \"air\"\nunit = \"C\"\nrange = [60, -40]\n\
             interval-s = 0\n\
             [[condition]]\nname = \"air\"\nunit = \"K\"\ncolour = \"red\"\n[[condition]]\n\
             name = \"air\"\nunit = \"%\"\n"
        );
        let found = mistakes(&text);
        let expected = [
            "condition.unit: is \"C\", must be one of \"degC\", \"K\", \"%\"",
            "condition.range: is [60, -40], must be the lowest and the highest plausible value",
            "condition.interval-s: is 0, must be a finite number above 0",
            "condition.colour: is not a known key",
            "condition.name: repeats \"air\", must be unique",
        ];
        for start in expected {
            assert!(
                found.iter().any(|told| told.starts_with(start)),
                "{start}\n{found:#?}"
            );
        }
    }

    #[test]
    fn condition_leaves_the_basis_of_the_identification() {
        let with = format!("{DEMO}\n[[condition]]\nname = \"air\"\nunit = \"K\"\n");
        assert_eq!(
            read(&with).unwrap().identification_basis(),
            read(DEMO).unwrap().identification_basis()
        );
    }
}
