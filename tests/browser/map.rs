//! The map of the structures.

use super::{Program, browser, example, free_address};
use crate::support::axe_or_skip;
use serde_json::json;

/// Names, latitudes and longitudes (degrees) of the structures with coordinates.
const PLACES: [(&str, f64, f64); 3] = [
    ("south-west", 60.0, 10.0),
    ("south-east", 60.0, 10.4),
    ("north-west", 60.2, 10.0),
];

#[tokio::test(flavor = "multi_thread")]
async fn structures_with_coordinates_are_on_a_map() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let text = std::fs::read_to_string(example("demo.toml")).unwrap();
    let named = |name: &str| text.replacen("name = \"demo\"", &format!("name = \"{name}\""), 1);
    let write = |name: &str, text: String| {
        std::fs::write(folder.path().join(format!("{name}.toml")), text).unwrap();
    };
    for (name, latitude, longitude) in PLACES {
        let place = format!("\n[place]\nlatitude = {latitude:?}\nlongitude = {longitude:?}\n");
        write(name, named(name) + &place);
    }
    write("elsewhere", named("elsewhere"));
    let names: Vec<String> = PLACES
        .iter()
        .map(|(name, ..)| *name)
        .chain(["elsewhere"])
        .map(|name| {
            let file = folder.path().join(format!("{name}.toml"));
            file.to_str().unwrap().to_owned()
        })
        .collect();
    let configuration = format!(
        "structures = {names:?}\n[bus]\nlisten = [\"tcp/{}\"]\n[dashboard]\n\
         listen = \"127.0.0.1:0\"\n\
         [history]\ndatabase = \"none\"\n[state]\nfolder = \"none\"\n",
        free_address()
    );
    let file = folder.path().join("spandrel.toml");
    std::fs::write(&file, configuration).unwrap();
    let run = Program::start(&["run", "--config", file.to_str().unwrap()]);
    browser.resize(1280, 900).await;
    browser.prefer("light").await;
    browser.open(&run.page).await;
    browser
        .wait(
            "three structures on the map",
            "document.querySelectorAll('.map-drawing .site').length === 3",
        )
        .await;
    browser.screenshot("map-light").await;

    // Equal distances north and east have equal lengths. At 60° N, a degree of longitude is half as
    // long as one of latitude, so that both distances are equal here, up to the curvature.
    let place = |name: &str, axis: &str| {
        format!(
            "Number(document.querySelector('.site[data-name={name}] \
             circle').getAttribute('c{axis}'))"
        )
    };
    let distance =
        |a: &str, b: &str, axis: &str| format!("{} - {}", place(a, axis), place(b, axis));
    let east = distance("south-east", "south-west", "x");
    let east = browser.evaluate(&east).await.as_f64().unwrap();
    let north = distance("south-west", "north-west", "y");
    let north = browser.evaluate(&north).await.as_f64().unwrap();
    assert!(
        east > 50.0 && (east / north - 1.0).abs() < 0.01,
        "{east} px east, {north} px north"
    );
    let label = "document.querySelector('.site[data-name=south-east]').getAttribute('aria-label')";
    let label = browser.evaluate(label).await;
    assert!(
        label.as_str().unwrap().starts_with("south-east: "),
        "{label}"
    );

    if let Some(axe) = axe_or_skip() {
        let axe = std::fs::read_to_string(axe).unwrap();
        browser.evaluate(&format!("{axe}; true")).await;
        let found = "axe.run(document, { resultTypes: ['violations'] }).then(({ violations }) => \
                     violations.map(({ id, nodes }) => `${id}: ${nodes.map(({ target }) => \
                     target.join(' ')).join(', ')}`))";
        assert_eq!(browser.evaluate(found).await, json!([]));
    }
    browser.prefer("dark").await;
    browser.screenshot("map-dark").await;
    browser.resize(390, 844).await;
    let width = "document.documentElement.scrollWidth";
    assert_eq!(browser.evaluate(width).await, 390);
    browser.screenshot("map-phone").await;

    browser
        .evaluate("document.querySelector('.site[data-name=south-east]').focus()")
        .await;
    browser.press("Enter").await;
    browser
        .wait(
            "the structure",
            "location.hash === '#/structure/south-east' && document.querySelector('.drawing')",
        )
        .await;
    assert_eq!(browser.complaints(), Vec::<String>::new());
}
