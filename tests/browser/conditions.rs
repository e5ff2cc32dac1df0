//! Conditions on the page of a structure: the latest value, its age, and the plot.

use super::{Program, browser, free_address};
use std::net::UdpSocket;
use std::path::Path;
use std::time::Duration;

/// Two conditions. The first one is overdue after 2 s, and the second one has no instrument.
const CONDITIONS: &str = "[[condition]]\nname = \"deck-temperature\"\nunit = \"degC\"\n\
                          range = [-40, 60]\ninterval-s = 1\n\
                          [[condition]]\nname = \"wind\"\nunit = \"m/s\"\n";

#[tokio::test(flavor = "multi_thread")]
async fn a_temperature_is_shown_plotted_and_marked_when_it_is_overdue() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let demo = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml");
    let structure = folder.path().join("demo.toml");
    let text = std::fs::read_to_string(demo).unwrap() + "\n" + CONDITIONS;
    std::fs::write(&structure, text).unwrap();
    let instrument = UdpSocket::bind("127.0.0.1:0").unwrap();
    let station = instrument.local_addr().unwrap().to_string();
    drop(instrument);
    let configuration = folder.path().join("spandrel.toml");
    let text = format!(
        "structures = [{structure:?}]\n[bus]\nlisten = [\"tcp/{}\"]\n[dashboard]\n\
         listen = \"127.0.0.1:0\"\n\
         [history]\ndatabase = \"none\"\n[state]\nfolder = \"none\"\n[[feed.source]]\n\
         name = \"weather-station\"\n\
         kind = \"udp\"\naddress = \"{station}\"\nformat = \"json\"\n[[feed.source.condition]]\n\
         source = \"t\"\n\
         condition = \"deck-temperature\"\n",
        free_address()
    );
    std::fs::write(&configuration, text).unwrap();
    let services = Program::start(&["run", "--config", configuration.to_str().unwrap()]);
    browser.resize(1280, 900).await;
    browser.prefer("light").await;
    browser.open(&services.page).await;
    browser
        .evaluate("location.hash = '#/structure/demo/sensors'")
        .await;
    let list = "(document.getElementById('conditions')?.textContent ?? '')";
    let empty = format!("{list}.includes('○ deck-temperature: no value yet')");
    browser.wait("a condition without a value", &empty).await;
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    let sending = tokio::spawn(async move {
        for tenths in 0_i32.. {
            let line = format!("{{\"t\": {}}}", f64::from(tenths % 40) / 10.0 - 3.5);
            // The feed may not listen yet.
            let _ = socket.send_to(line.as_bytes(), &station);
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    });
    let value = format!("/● deck-temperature: .* °C, .* ago \\(weather-station\\)/.test({list})");
    browser.wait("a value", &value).await;
    let readout = "document.querySelector('#plot-condition-deck-temperature .readout').textContent";
    browser
        .evaluate("document.getElementById('group-conditions').scrollIntoView()")
        .await;
    browser
        .wait(
            "a plotted value",
            &format!("/ · -?[0-9.]+ °C/.test({readout})"),
        )
        .await;
    browser.screenshot("conditions").await;
    let empty = format!("{list}.includes('○ wind: no value yet')");
    assert_eq!(browser.evaluate(&empty).await, true);
    sending.abort();
    let overdue = format!("/▲ deck-temperature: .*, the next value is overdue/.test({list})");
    browser.wait("an overdue value", &overdue).await;
    assert_eq!(
        browser.complaints(),
        Vec::<String>::new(),
        "the page complained"
    );
}
