//! The export of samples around an event and of a chosen range.

use super::{browser, demo};
use crate::support::skip;
use base64::Engine as _;
use serde_json::{Value, json};
use spandrel_record::{ReadOptions, RecordedChannel, RecordedFile};
use std::path::Path;
use std::process::Command;

/// Collects the files that the page saves, instead of saving them.
const COLLECT: &str = "(() => {
    window.files = [];
    let content;
    URL.createObjectURL = (blob) => { content = blob; return '#'; };
    HTMLAnchorElement.prototype.click = async function () {
        const name = this.download;
        const bytes = new Uint8Array(await content.arrayBuffer());
        window.files.push([name, btoa(Array.from(bytes, (byte) => \
        String.fromCharCode(byte)).join(''))]);
    };
  })()";

/// Compares the messages of an MCAP file with the rows of a CSV file.
const READER: &str = r"
import csv, json, sys
from mcap.reader import make_reader
mcap, table = sys.argv[1:]
rows = list(csv.reader(open(table)))
names = [name.split(' [')[0] for name in rows[0][1:]]
expected = {name: [float(row[place]) for row in rows[1:]] for place, name in enumerate(names, 1)}
found = {name: [] for name in names}
with open(mcap, 'rb') as file:
    for _, channel, message in make_reader(file, validate_crcs=True).iter_messages():
        found[channel.topic].append(json.loads(message.data)['value'])
assert found == expected and len(rows) > 100, (len(rows), {name: len(values) for name, values in found.items()})
";

/// Returns the bits of all samples, and their times in ns.
fn samples(channel: &RecordedChannel) -> (Vec<i64>, Vec<u64>) {
    let timed = channel.timed_samples();
    timed.map(|(time, value)| (time, value.to_bits())).unzip()
}

#[tokio::test(flavor = "multi_thread")]
async fn samples_around_an_event_are_saved_in_three_formats_with_equal_values() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.resize(1280, 900).await;
    browser
        .open(&format!("{}#/structure/demo/events", demo.page))
        .await;
    browser
        .wait(
            "an event, and the end of the demo",
            "document.querySelector('.events details') && \
             document.body.innerText.includes('record has ended')",
        )
        .await;
    browser.evaluate(COLLECT).await;
    let folder = tempfile::tempdir().unwrap();
    let mut files = Vec::new();
    for (place, ending) in ["mcap", "mseed", "csv"].into_iter().enumerate() {
        let press = format!(
            "(document.querySelector('.events details').open = true, \
             document.querySelectorAll('.events details button')[{place}].click())"
        );
        browser.evaluate(&press).await;
        let saved = format!("window.files.length === {}", place + 1);
        browser.wait(ending, &saved).await;
        let file = browser.evaluate(&format!("window.files[{place}]")).await;
        let name = file[0].as_str().unwrap();
        assert!(
            name.starts_with("demo_") && name.ends_with(&format!(".{ending}")),
            "{name}"
        );
        let bytes = base64::prelude::BASE64_STANDARD
            .decode(file[1].as_str().unwrap())
            .unwrap();
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        files.push(path);
    }
    let read = |path: &Path| RecordedFile::read(path, &ReadOptions::default()).unwrap();
    let [mcap, mini_seed, table] = &files[..] else {
        panic!("{files:?}")
    };
    let (mcap_file, mini_seed_file, table_file) = (read(mcap), read(mini_seed), read(table));
    assert_eq!(mcap_file.channels().len(), 6);
    for (place, of_table) in table_file.channels().iter().enumerate() {
        let (times, bits) = samples(of_table);
        assert!(bits.len() > 100, "{}", bits.len());
        let of_mcap = &mcap_file.channels()[place];
        assert_eq!(of_table.name(), format!("{} [m/s2]", of_mcap.name()));
        let (same_times, same) = samples(of_mcap);
        assert!(same == bits && same_times == times, "{}", of_mcap.name());
        let of_mini_seed = &mini_seed_file.channels()[place];
        assert_eq!(of_mini_seed.name(), format!("XX.{:05}..HN1", place + 1));
        let (rounded, same) = samples(of_mini_seed);
        assert!(same == bits, "{}", of_mini_seed.name());
        // miniSEED states times in microseconds.
        assert!(
            times
                .iter()
                .zip(&rounded)
                .all(|(a, b)| a.abs_diff(*b) <= 501)
        );
    }
    let python = std::env::var("PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let compared = Command::new(python)
        .args(["-c", READER])
        .args([mcap, table])
        .output();
    match compared {
        Ok(output) if !String::from_utf8_lossy(&output.stderr).contains("ModuleNotFound") => {
            let told = String::from_utf8_lossy(&output.stderr);
            assert!(output.status.success(), "{told}");
        }
        _ => skip("python3 with the package mcap is not installed"),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_range_without_samples_is_refused_with_its_reason_on_the_page() {
    let Some(mut browser) = browser().await else {
        return;
    };
    let demo = demo(&[]);
    browser.resize(1280, 900).await;
    let long_ago = "#/structure/demo?from=1000000000&to=1000000060";
    browser.open(&format!("{}{long_ago}", demo.page)).await;
    let button = "document.querySelector('.ranges-bar .samples-export button')";
    let told = "(document.querySelector('.ranges-bar .samples-export .told')?.textContent ?? '')";
    browser.wait("the bar", button).await;
    browser.evaluate(&format!("{button}.click()")).await;
    browser
        .wait(
            "the reason",
            &format!("{told}.includes('no samples in this range')"),
        )
        .await;
    let refused: Value = browser
        .evaluate(
            "(async () => { const response = await \
                   fetch('/api/structures/demo/samples?from=1&to=2&format=xml'); return \
                   [response.status, await response.json()]; })()",
        )
        .await;
    let error = json!({"error": "format is `xml`", "allowed": "must be csv, mcap or mseed"});
    assert_eq!(refused, json!([400, error]));
}
