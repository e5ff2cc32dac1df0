//! Tests of valid `[classes]` tables, and of mistakes with the class that contains them.

use crate::Diagnostic;
use crate::file::tests::{DEMO, mistakes, read};

/// Returns the mistakes in the demo with a `[classes]` table.
#[track_caller]
fn class_mistakes(table: &str) -> Vec<String> {
    mistakes(&format!("{DEMO}\n{table}"))
}

#[test]
fn classes_are_read_with_their_groups() {
    let text = format!(
        "{DEMO}\n[classes]\nkind = \"predefined\"\nfloor = 1e-6\npersistence-s = 2\n\
         [[classes.class]]\nname = \"all\"\ngroups = []\n\
         [[classes.class]]\nname = \"lowest\"\ngroups = [[\"storey-1\"]]\n"
    );
    let settings = read(&text).unwrap().class_settings().unwrap();
    assert_eq!((settings.floor, settings.persistence_steps), (1e-6, 200));
    let text = format!("{DEMO}\n[classes]\nkind = \"self-calibrating\"\n");
    let structure = read(&text).unwrap();
    // Two fundamental periods of 1 s at 100 Hz.
    assert_eq!(structure.class_settings().unwrap().persistence_steps, 200);
}

#[test]
fn error_names_mistakes_of_classes() {
    let has = |table: &str, parts: &[&str]| {
        let found = class_mistakes(table);
        assert!(
            found
                .iter()
                .any(|mistake| parts.iter().all(|part| mistake.contains(part))),
            "{table}\n  expected {parts:?}\n  found    {found:?}"
        );
    };
    let predefined = |classes: &str| format!("[classes]\nkind = \"predefined\"\n{classes}");
    let class = |name: &str, groups: &str| {
        format!("[[classes.class]]\nname = \"{name}\"\ngroups = {groups}\n")
    };
    has("[classes]\n", &["classes.kind", "predefined"]);
    has(
        &predefined(&class("one", "[[\"storey-1\"]]")),
        &["has 1 entry", "at least 2"],
    );
    has(
        &predefined(&class("one", "[[\"storey-9\"]]")),
        &["classes.class.groups", "storey-9", "storey-1"],
    );
    has(
        &predefined(&(class("one", "[[\"storey-1\", \"storey-1\"]]") + &class("two", "[]"))),
        &["names \"storey-1\" twice"],
    );
    has(
        &predefined(
            &(class("one", "[[\"storey-1\"]]")
                + &class(
                    "two",
                    "[[\"storey-2\",\"storey-3\",\"storey-4\",\"storey-5\"]]",
                )),
        ),
        &["groups \"two\" as \"one\" does"],
    );
    has(
        "[classes]\nkind = \"self-calibrating\"\nfloor = 0.3\n",
        &["classes.floor: is 0.3", "below 1/6"],
    );
    has(
        "[classes]\nkind = \"self-calibrating\"\npersistance-s = 1\n",
        &["persistance-s", "persistence-s"],
    );
    has(
        "[classes]\nkind = \"self-calibrating\"\n[[classes.class]]\nname = \"baseline\"\n\
         of = [\"storey-1\"]\n",
        &["is \"baseline\""],
    );
}

/// Reads the demo with a table of classes; returns each mistake with its line (from 1) in the
/// table.
#[track_caller]
fn mistakes_by_line(table: &str) -> Vec<(usize, String)> {
    let error = read(&format!("{DEMO}\n{table}")).expect_err("the file should be refused");
    let before = DEMO.lines().count() + 1;
    let told = |d: &Diagnostic| {
        (
            d.line() - before,
            format!("{}: {}, {}", d.key(), d.found(), d.allowed()),
        )
    };
    error.diagnostics().iter().map(told).collect()
}

fn table(kind: &str, classes: &[(&str, &str)]) -> String {
    let class =
        |(name, of): &(&str, &str)| format!("[[classes.class]]\nname = \"{name}\"\nof = {of}\n");
    format!(
        "[classes]\nkind = \"{kind}\"\n{}",
        classes.iter().map(class).collect::<String>()
    )
}

#[test]
fn error_names_the_line_of_a_mistake_of_a_class() {
    let (all, four) = (
        r#"["storey-1", "storey-2", "storey-3", "storey-4", "storey-5"]"#,
        r#"["storey-2", "storey-3", "storey-4", "storey-5"]"#,
    );
    let (low, high) = (
        r#"["storey-1", "storey-2"]"#,
        r#"["storey-3", "storey-4", "storey-5"]"#,
    );
    for (kind, classes, line, told) in [
        (
            "self-calibrating",
            vec![("low", low), ("all", all)],
            6,
            "lists all 5 stiffness parameters for \"all\", must leave",
        ),
        (
            "self-calibrating",
            vec![("one", "[\"storey-1\"]"), ("high", high), ("four", four)],
            9,
            "groups \"four\" as \"one\" does, must distinguish every class",
        ),
        (
            "self-calibrating",
            vec![("low", low), ("none", "[]")],
            8,
            "classes.class.of: has an empty list, must name",
        ),
        (
            "hierarchical",
            vec![("low", low), ("same", "[\"storey-2\"]"), ("high", high)],
            8,
            "names \"storey-2\", which \"low\" names too, must be in one substructure only",
        ),
        (
            "hierarchical",
            vec![("low", low), ("high", high)],
            1,
            "has 2 substructures, must have at least 3: with two",
        ),
        (
            "hierarchical",
            vec![
                ("low", low),
                ("third", "[\"storey-3\"]"),
                ("fifth", "[\"storey-5\"]"),
            ],
            1,
            "leaves out \"storey-4\", must have each stiffness parameter in one substructure",
        ),
    ] {
        let found = mistakes_by_line(&table(kind, &classes));
        assert_eq!(found.len(), 1, "{found:?}");
        assert_eq!(found[0].0, line, "{found:?}");
        assert!(found[0].1.contains(told), "{found:?}");
    }
}

#[test]
fn three_substructures_are_enough() {
    let parts = [
        ("low", r#"["storey-1", "storey-2"]"#),
        ("third", r#"["storey-3"]"#),
        ("top", r#"["storey-4", "storey-5"]"#),
    ];
    let structure = read(&format!("{DEMO}\n{}", table("hierarchical", &parts))).unwrap();
    assert_eq!(structure.class_bank().unwrap().unwrap().classes().len(), 4);
}

#[test]
fn floor_of_zero_is_the_rule_of_the_source() {
    let text = format!("{DEMO}\n[classes]\nkind = \"self-calibrating\"\nfloor = 0\n");
    let structure = read(&text).unwrap();
    assert_eq!(structure.class_settings().unwrap().floor, 0.0);
    assert!(structure.class_bank().is_ok());
}

#[test]
fn numbers_out_of_range_or_without_use_are_rejected() {
    for (kind, key, told) in [
        (
            "self-calibrating",
            "persistence-s = 1e300",
            "is 1e300, must be from 0.01 to 100000, which is 1 to 10000000 samples",
        ),
        (
            "self-calibrating",
            "persistence-s = 0.001",
            "is 0.001, 0 samples at 100 Hz",
        ),
        (
            "self-calibrating",
            "reset-std = 1e200",
            "is 1e200, must be a finite number from 1e-9 and up to 1e6",
        ),
        (
            "predefined",
            "reset-std = 0.2",
            "classes.reset-std: is given, must not be given for kind \"predefined\"",
        ),
    ] {
        let found = mistakes(&format!("{DEMO}\n[classes]\nkind = \"{kind}\"\n{key}\n"));
        assert!(
            found.iter().any(|mistake| mistake.contains(told)),
            "{found:?}"
        );
    }
}
