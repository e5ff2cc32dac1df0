//! Tutorials of the book: every command runs as printed, starting in an empty folder, as a new user
//! would run it.
//!
//! The records are not part of the repository but in `shared/data` next to it. Without that folder
//! these tests are skipped, or fail if `REQUIRE_ALL_TESTS` is set.

use crate::support::page::{Page, here, root};
use crate::support::{Lab, Process, five_storeys, records_or_skip, skip};
use std::path::Path;
use std::process::Command;

/// Runs in its own network, because the page states the ports of the services.
#[test]
fn the_ten_minute_tutorial_works_as_printed() {
    let Some(lab) = Lab::or_skip(&["desk"], 1) else {
        return;
    };
    assert_eq!(Page::open("start.md").follow(|| lab.inside("desk")), 9);
}

#[test]
fn the_tutorial_on_a_year_works_as_printed() {
    assert_eq!(Page::open("year.md").follow(here), 10);
}

#[test]
fn the_laboratory_frame_tutorial_works_as_printed() {
    let Some(records) = records_or_skip("mini-shake-table") else {
        return;
    };
    let page = Page::open("laboratory-frame.md");
    for (state, sensor) in ["stiff", "flexible"]
        .into_iter()
        .flat_map(|state| ["ground", "floor1", "floor2", "floor3"].map(|sensor| (state, sensor)))
    {
        let packed = records.join(format!("raw/{state}-northridge-{sensor}.csv.gz"));
        page.have_unpacked(&packed, &format!("{state}-northridge/{sensor}.csv"));
    }
    for state in ["stiff", "flexible"] {
        page.have(&root().join(format!("docs/examples/shake-table-{state}.toml")));
        for motion in ["sine1.0", "sine2.0"] {
            page.have(&records.join(format!("aligned/{state}-{motion}.csv")));
        }
    }
    assert_eq!(page.follow(here), 10);
    for state in ["stiff", "flexible"] {
        let name = format!("{state}-northridge.csv");
        let kept = std::fs::read_to_string(records.join("aligned").join(&name)).unwrap();
        assert!(
            page.read(&name) == kept,
            "{name} differs from the file among the records"
        );
    }
}

#[test]
fn the_highway_bridge_tutorial_works_as_printed() {
    let Some(records) = records_or_skip("painter-street-bridge") else {
        return;
    };
    let page = Page::open("highway-bridge.md");
    let events = [
        "petroliaaftershock1_26apr1992",
        "RioDell_14Sep2012_71842255",
        "bayview_11oct2013_72086051",
        "riodell_19oct2014_72330211",
        "ferndale_28jan2015_72387946",
        "petrolia_05dec2016_72733405",
        "ferndaleoffshore_08dec2016_us20007z6r",
        "nc73666231",
        "nc73667866",
        "nc73821036",
        "nc73821636",
        "nc73943821",
    ];
    for event in events {
        page.have(&records.join(format!("{event}_ce89324p.zip")));
    }
    assert_eq!(page.follow(here), 12);
}

#[test]
fn the_earthquake_page_works_as_printed() {
    let Some(records) = records_or_skip("painter-street-bridge") else {
        return;
    };
    let page = Page::open("earthquakes.md");
    page.have(&root().join("docs/examples/earthquake/highway-bridge.toml"));
    for archive in std::fs::read_dir(&records).unwrap() {
        let path = archive.unwrap().path();
        if path.extension().is_some_and(|extension| extension == "zip") {
            page.have(&path);
        }
    }
    assert_eq!(page.follow(here), 2);
}

/// Tests the subscriber of docs/topics.md. It queries the default address and therefore has its own
/// network.
#[test]
fn the_subscriber_in_rust_prints_the_parameters_of_the_demo() {
    let Some(lab) = Lab::or_skip(&["desk"], 3) else {
        return;
    };
    let example = Path::new(env!("CARGO_BIN_EXE_spandrel"))
        .with_file_name("examples")
        .join("subscribe");
    if !example.exists() {
        skip(
            "the example subscribe does not exist; `cargo test --workspace` builds it, and \
             `--test program` does not",
        );
        return;
    }
    let on_desk = |command: Command| {
        let mut inside = lab.inside("desk");
        inside.arg(command.get_program()).args(command.get_args());
        Process::start(&mut inside)
    };
    let mut run = lab.spandrel("desk", "run");
    let run = Process::start(run.arg(five_storeys()).args(["-v", "--http", "none"]));
    run.wait_for_log("ready structures=1");
    let subscriber = on_desk(Command::new(example));
    let mut simulate = lab.spandrel("desk", "simulate");
    simulate.arg(five_storeys()).args([
        "--live",
        "--duration",
        "600",
        "--connect",
        "tcp/127.0.0.1:7447",
    ]);
    let _simulate = Process::start(&mut simulate);
    subscriber.wait_for_output("every parameter", |printed| {
        let of = |name: &str| printed.contains(&format!("spandrel/demo/parameter/{name}: "));
        (1..=5).all(|storey| of(&format!("storey-{storey}")))
    });
}
