//! The year of a judged quantity on the page: 510 days that the service judge has in its file.

use super::{Browser, Program, browser, free_address};
use serde_json::json;
use spandrel_checkpoint::fingerprint;
use spandrel_validate::{StiffnessLoss, seasons};
use std::fmt::Write as _;
use std::path::Path;

const JUDGE: &str = "[judge]\nepoch-s = 21600\n\
                     [[judge.quantity]]\nname = \"storey-1\"\nis = \"stiffness\"\n\
                     [[judge.quantity]]\nname = \"storey-2\"\nis = \"stiffness\"\n\
                     [[judge.condition]]\nname = \"deck\"\nunit = \"degC\"\n";
const LOSS: StiffnessLoss = StiffnessLoss {
    share: 0.05,
    day: 480,
    repair_day: None,
};
/// Frequencies of the two modes of the simulated seasons at 0 °C (Hz).
const FREQUENCIES: [f64; 2] = [2.31, 3.87];
/// Number of bytes of a check value.
const CHECK_BYTES: usize = 8;

/// Returns the file of the epochs as the service writes it.
fn epochs() -> String {
    let check = |text: &str, before: &str| {
        let all = fingerprint(&format!("{before}{text}"));
        all[..CHECK_BYTES]
            .iter()
            .fold(String::new(), |mut hex, byte| {
                write!(hex, "{byte:02x}").unwrap();
                hex
            })
    };
    let mut text = "time,storey-1,storey-2,deck,deviation(storey-1),deviation(storey-2),\
                    spandrel-measured,spandrel-check\n"
        .to_owned();
    let mut before = check(&text, "");
    for row in seasons(1, 510, Some(LOSS)) {
        let mut line = format!("{:.9},", row.time_s());
        for (value, at_zero) in row.frequencies.into_iter().zip(FREQUENCIES) {
            if let Some(value) = value {
                write!(line, "{}", (value / at_zero).powi(2)).unwrap();
            }
            line.push(',');
        }
        write!(line, "{},,,1,", row.deck).unwrap();
        before = check(&line, &before);
        text += &format!("{line}{before}\n");
    }
    text
}

#[tokio::test(flavor = "multi_thread")]
async fn the_year_of_a_quantity_is_shown_read_zoomed_and_linked() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let demo = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml");
    let structure = folder.path().join("demo.toml");
    let text = std::fs::read_to_string(demo).unwrap() + "\n" + JUDGE;
    std::fs::write(&structure, text).unwrap();
    let state = folder.path().join("state");
    let saved = state.join("spandrel/demo/checkpoints");
    std::fs::create_dir_all(&saved).unwrap();
    std::fs::write(saved.join("judge-epochs.csv"), epochs()).unwrap();
    let configuration = folder.path().join("spandrel.toml");
    let text = format!(
        "structures = [{structure:?}]\n[bus]\nlisten = [\"tcp/{}\"]\n[dashboard]\n\
         listen = \"127.0.0.1:0\"\n\
         [history]\ndatabase = \"none\"\n[state]\nfolder = {state:?}\n",
        free_address()
    );
    std::fs::write(&configuration, text).unwrap();
    let services = Program::start(&["run", "--config", configuration.to_str().unwrap()]);
    browser.resize(1280, 1000).await;
    browser.prefer("light").await;
    browser.open(&services.page).await;
    browser.evaluate("location.hash = '#/structure/demo'").await;
    the_present_state_leads_to_the_year(&mut browser).await;
    the_first_quantity_has_lost_stiffness(&mut browser).await;
    the_loss_is_listed_among_the_alerts(&mut browser).await;
    a_report_without_new_data_contains_the_loss(&mut browser).await;
    a_note_is_entered_by_keyboard(&mut browser).await;
    the_loss_that_somebody_has_seen_has_a_history(&mut browser).await;
    another_quantity_has_its_own_address(&mut browser).await;
    the_plots_are_zoomed_and_read_by_keyboard(&mut browser).await;
    a_phone_shows_the_year_without_scrolling_aside(&mut browser).await;
    assert_eq!(
        browser.complaints(),
        Vec::<String>::new(),
        "the page complained"
    );
    the_days_are_served_as_csv(&mut browser).await;
}

/// Returns an expression: the text above a plot, which states the day at the crosshair.
fn readout(plot: &str) -> String {
    format!("document.querySelector('#plot-{plot} .readout').textContent")
}

/// Returns an expression: the text of the panel of lasting change.
const PANEL: &str = "document.getElementById('panel-lasting').innerText";

/// Returns an expression: whether the page states the loss of the first quantity, and only once.
fn lost_once() -> String {
    let page = "document.querySelector('.structure').innerText";
    format!("{page}.match(/storey-1 has lost [0-9.]+ % of stiffness/g)?.length === 1")
}

async fn the_present_state_leads_to_the_year(browser: &mut Browser) {
    let list = "document.getElementById('judgements')";
    let lost = format!(
        "/▲ lasting loss: storey-1 has lost .* Found on 2025-1.-..[.] Last epoch \
         2025-11-22/.test({list}.textContent)"
    );
    browser
        .wait("the state among the present ones", &lost)
        .await;
    browser
        .evaluate(&format!("{list}.querySelector('a').click()"))
        .await;
    let address = "location.hash === '#/structure/demo/lasting?quantity=storey-1'";
    browser.wait("the address of the year", address).await;
}

async fn the_first_quantity_has_lost_stiffness(browser: &mut Browser) {
    browser.wait("a lasting loss", &lost_once()).await;
    let day = format!(
        "/^2025-11-2. · measured .* · expected .* · since the change$/.test({})",
        readout("year")
    );
    browser.wait("the last day in the plot", &day).await;
    // Regression: the logarithm was called evidence, and the line had two names.
    let evidence = format!(
        "/^2025-11-2. · ln evidence [0-9.]+ [(]threshold [0-9.]+[)] · slow drift: [0-9.]+ × its \
         threshold$/.test({})",
        readout("evidence")
    );
    browser
        .evaluate("document.querySelector('#plot-evidence').scrollIntoView()")
        .await;
    browser.wait("the evidence in words", &evidence).await;
    for part in [
        "2024-07-01 to 2025-06-30",
        "0.05, of 0.1 for the structure",
        "1 (1 in the last year)",
        "mostly missed",
    ] {
        let told = format!("{PANEL}.includes('{part}')");
        browser.wait(part, &told).await;
    }
    browser.screenshot("lasting-change").await;
    browser.prefer("dark").await;
    browser.screenshot("lasting-change-dark").await;
    browser.prefer("light").await;
}

async fn the_loss_is_listed_among_the_alerts(browser: &mut Browser) {
    let button = "document.querySelector('.attention .actions button.acknowledge')?.textContent \
                  === 'Acknowledge the lasting loss of storey-1'";
    browser.wait("a button for the loss", button).await;
    browser.evaluate("location.hash = '#/alerts'").await;
    let card = "document.querySelector('.alerts:not(.past) .alert[data-state=raised]')";
    let year = "'#/structure/demo/lasting?quantity=storey-1'";
    let listed = format!(
        "/storey-1 [(]lasting loss[)]/.test({card}?.textContent) \
         && /^raised 2025-1.-..$/.test({card}.querySelector('.when').textContent) \
         && {card}.querySelector('a.button').hash === {year}"
    );
    browser.wait("the loss among the alerts", &listed).await;
    // Regression: the history repeated the alarm that stands above.
    let repeated = "document.querySelector('.alerts.past .alert[data-state=raised]') !== null";
    assert_eq!(browser.evaluate(repeated).await, false);
    let back = format!("location.hash = {year}");
    browser.evaluate(&back).await;
    browser.wait("the year again", &lost_once()).await;
}

/// Regression test: without data since the start of the server, one sentence was the whole report.
async fn a_report_without_new_data_contains_the_loss(browser: &mut Browser) {
    // The period, 2025-11-13 to 2025-11-22, begins after the loss was found.
    let open = "location.hash = '#/report?structures=demo&from=1763000000&to=1763800000'";
    browser.evaluate(open).await;
    let complete = "document.querySelector('.report[data-state=complete]')";
    browser.wait("the report", complete).await;
    let told = "(() => { const report = document.querySelector('.report-structure'); \
                const row = report.querySelector('.is-events tbody tr'); \
                return [report.querySelector('.badge').textContent, \
                /^2025-1.-..$/.test(row.children[0].textContent), \
                /^▲ raised [(]lasting loss[)] storey-1 has lost /.test(row.children[2].textContent), \
                report.querySelectorAll('.chart .dot').length > 300, \
                report.querySelectorAll('.is-sensors tbody tr').length]; })()";
    assert_eq!(
        browser.evaluate(told).await,
        json!(["▲ Alarm", true, true, true, 6])
    );
    let back = "location.hash = '#/structure/demo/lasting?quantity=storey-1'";
    browser.evaluate(back).await;
    let shown = format!(
        "{} && document.getElementById('add-note') !== null",
        lost_once()
    );
    browser.wait("the year after the report", &shown).await;
}

async fn a_note_is_entered_by_keyboard(browser: &mut Browser) {
    let focus_of = |id: &str| format!("document.activeElement.id === '{id}'");
    browser
        .evaluate("document.getElementById('add-note').focus()")
        .await;
    browser.press("Enter").await;
    let first = focus_of("note-subject");
    browser.wait("the form of a note", &first).await;
    for _ in 0..3 {
        browser.press("Tab").await;
    }
    browser.write("crack in the bearing").await;
    browser.press("Tab").await;
    browser.write("Ada").await;
    let set = "document.getElementById('note-effect').value = 'seen'; \
               document.getElementById('note-from').value = '2199-01-01T00:00:00'; \
               document.querySelector('#note-dialog button[type=submit]').focus(); true";
    browser.evaluate(set).await;
    browser.press("Enter").await;
    let wrong = format!(
        "{} && document.querySelector('#note-dialog .told').textContent.includes('in the future')",
        focus_of("note-from")
    );
    browser.wait("the mistake, with its field", &wrong).await;
    browser.screenshot("note").await;
    let clear = "document.getElementById('note-from').value = ''; \
                 document.querySelector('#note-dialog button[type=submit]').focus(); true";
    browser.evaluate(clear).await;
    browser.press("Enter").await;
    let noted = "/inspection, acknowledged by Ada: crack in the bearing/\
                 .test(document.querySelector('.notes').textContent) \
                 && !document.getElementById('note-dialog').open";
    browser.wait("the note, without a reload", noted).await;
    let seen = format!("/Acknowledged by Ada on 20..-..-..: crack in the bearing/.test({PANEL})");
    browser.wait("a change that somebody has seen", &seen).await;
}

async fn the_loss_that_somebody_has_seen_has_a_history(browser: &mut Browser) {
    browser.evaluate("location.hash = '#/alerts'").await;
    let card = "document.querySelector('.alerts:not(.past) .alert[data-state=acknowledged]')";
    let both = format!(
        "/^raised 2025-1.-.. · acknowledged 20..-..-.. ..:..:.. UTC$/.test({card}?.querySelector('.when').textContent)"
    );
    browser.wait("both times", &both).await;
    let past = "document.querySelector('.alerts.past .alert[data-state=raised]')";
    let changed = format!("/storey-1 [(]lasting loss[)]/.test({past}?.textContent)");
    browser.wait("the loss in the history", &changed).await;
    browser
        .evaluate("location.hash = '#/structure/demo/lasting?quantity=storey-1'")
        .await;
    let named = "/; acknowledged by Ada: crack in the bearing/\
                 .test(document.querySelector('.attention .sentence')?.textContent) \
                 && document.querySelector('.quantities a') !== null";
    browser.wait("who has acknowledged the loss", named).await;
}

async fn another_quantity_has_its_own_address(browser: &mut Browser) {
    let open = "document.querySelectorAll('.quantities a')[1].click()";
    browser.evaluate(open).await;
    let sound = format!("/storey-2 shows no lasting change/.test({PANEL})");
    browser.wait("a sound quantity", &sound).await;
    let address = "location.hash === '#/structure/demo/lasting?quantity=storey-2'";
    browser.wait("the address of the quantity", address).await;
    browser.reload().await;
    browser
        .wait("the same quantity after a reload", &sound)
        .await;
}

async fn the_plots_are_zoomed_and_read_by_keyboard(browser: &mut Browser) {
    let drawn = format!("/^2025-11-2. · /.test({})", readout("year"));
    browser.wait("the days", &drawn).await;
    browser
        .evaluate("document.querySelector('#plot-year .plot-holder').focus()")
        .await;
    browser.press("ArrowLeft").await;
    let read = readout("residuals");
    let same = format!("{}.slice(0, 10) === {read}.slice(0, 10)", readout("year"));
    browser.wait("a common crosshair", &same).await;
    browser.press("+").await;
    let zoomed = "/from=.*&to=/.test(location.hash)";
    browser.wait("a zoom in the address", zoomed).await;
    browser.press("Home").await;
    let whole = "location.hash === '#/structure/demo/lasting?quantity=storey-2'";
    browser.wait("the whole year", whole).await;
    browser
        .evaluate("document.querySelector('#plot-scatter').scrollIntoView()")
        .await;
    // Regression: it was the warmest day.
    let scatter = format!(
        "/^2025-11-2. · [−-]?[0-9.]+ °C · measured /.test({})",
        readout("scatter")
    );
    browser.wait("values over the temperature", &scatter).await;
    // A hollow shape means the same in all plots of the tab.
    let hollow = "['year', 'scatter'].map((plot) => [...document.querySelectorAll(`#plot-${plot} \
                  .legend [fill=none]:only-child`)].map((one) => one.closest('li').textContent))";
    let outside = ["outside experience"];
    assert_eq!(
        browser.evaluate(hollow).await,
        json!([outside, outside]),
        "hollow shapes"
    );
}

async fn the_days_are_served_as_csv(browser: &mut Browser) {
    let fetched = "fetch('/api/structures/demo/judgements/storey-1/course?format=csv').then((answer) => answer.text())";
    let text = browser.evaluate(fetched).await;
    let lines: Vec<&str> = text.as_str().unwrap().lines().collect();
    assert!(
        lines[0].starts_with("date,quantity,state,change,"),
        "{}",
        lines[0]
    );
    // The last day is not over.
    assert_eq!(lines.len(), 1 + 509);
    assert!(
        lines[509].starts_with("2025-11-21,storey-1,judged,lasting-loss,"),
        "{}",
        lines[509]
    );
    let unknown =
        "fetch('/api/structures/demo/judgements/pier/course').then((answer) => answer.status)";
    assert_eq!(browser.evaluate(unknown).await, 404);
}

async fn a_phone_shows_the_year_without_scrolling_aside(browser: &mut Browser) {
    browser.resize(390, 844).await;
    browser.evaluate("scrollTo(0, 0)").await;
    let fits = "document.documentElement.scrollWidth <= innerWidth";
    browser.wait("a page as wide as the phone", fits).await;
    browser.screenshot("lasting-change-phone").await;
}
