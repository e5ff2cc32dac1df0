//! Nodes that identify their own parameters and a station that fuses the results, as separate
//! processes over Zenoh.
//!
//! The building of `spandrel demo --distributed` has forty storeys and sixteen nodes. One node is
//! always wrong, and one is silent for a while.

use crate::support::{DEADLINE, EstimateReader, Process, Site, assert_same_bits, spandrel, within};
use spandrel_bus::{
    AlertMessage, AlertState, Event, EventKind, LocalMessage, Message, Name, NodeDisplay,
    NodeHealth, OutlierDisplay, Service, SpectrumDisplay, WaveformDisplay,
};
use std::collections::BTreeMap;
use std::path::Path;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

fn demo(pairs: &[(&str, &str)]) -> String {
    let path =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo-distributed.toml");
    let mut text = std::fs::read_to_string(path).unwrap();
    for (old, new) in pairs {
        assert!(text.contains(old), "the example has no {old:?}");
        text = text.replacen(old, new, 1);
    }
    text
}

#[tokio::test(flavor = "multi_thread")]
async fn nodes_in_three_processes_and_a_station_give_the_numbers_of_a_record() {
    let site = Site::with(&demo(&[]));
    let record = site.simulate(12.0);
    // The station, then two processes with half of the nodes each, then one for alerts.
    let station = Process::start(&mut site.listening("fuse"));
    station.wait_for_log("ready structures=1");
    let names: Vec<String> = site
        .structure()
        .nodes()
        .iter()
        .map(|node| node.name().to_owned())
        .collect();
    let halves: Vec<Process> = names
        .chunks(8)
        .map(|half| {
            let mut command = site.connecting("identify");
            for name in half {
                command.args(["--node", name]);
            }
            let process = Process::start(&mut command);
            process.wait_for_log("ready structures=1");
            process
        })
        .collect();
    let alert = Process::start(&mut site.connecting("alert"));
    alert.wait_for_log("ready structures=1");
    let bus = site.join().await;
    let mut reader = EstimateReader::join(&bus, &site.keys()).await;
    let local = bus
        .subscribe::<LocalMessage>(site.keys().all_local(), 1 << 12)
        .await
        .unwrap();
    site.replay(&record, "max").wait().expect_code(0);
    let streamed = reader.read_to_end(1).await;
    let offline = site.estimate(&record);
    assert_eq!(offline.frames.len(), 12);
    assert_same_bits(
        "nodes and station",
        &offline.parameters,
        &offline.frames,
        streamed,
    );
    // A final message of each node announces the end of its samples.
    assert_eq!(local.messages().drain().count(), 16 * 13);
    for process in halves.into_iter().chain([alert, station]) {
        process.stop().expect_code(0);
    }
}

#[test]
fn node_that_measures_only_the_excitation_participates() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml");
    let text = std::fs::read_to_string(path).unwrap();
    for motion in ["none", "modes", "samples"] {
        let site = Site::with(
            &format!("{text}\n[fusion]\nmotion = \"{motion}\"\n").replacen(
                "sampling-rate-hz",
                "identification = \"distributed\"\nsampling-rate-hz",
                1,
            ),
        );
        let offline = site.estimate(&site.simulate(20.0));
        assert_eq!(offline.frames.len(), 20, "{motion}");
        let nodes = offline.summary["nodes"].as_array().unwrap();
        let names = nodes.iter().map(|node| node["node"].as_str().unwrap());
        assert_eq!(
            names.collect::<Vec<_>>(),
            [
                "ground", "floor-1", "floor-2", "floor-3", "floor-4", "floor-5"
            ],
            "{motion}"
        );
        for node in nodes {
            let takes_part = node["state"] == "used"
                && node["excluded"] == 0
                && node["silent"].as_array().unwrap().is_empty()
                && node["fusions"].as_u64().unwrap() >= 19;
            assert!(takes_part, "{motion}: {node}");
        }
        // All stiffnesses of the building are 1. Twenty seconds reduce the standard deviation of
        // the prior, 0.2, to less than a third.
        let last = offline.frames.last().unwrap();
        for (name, (mean, std)) in offline.parameters.iter().zip(&last.mean_and_std) {
            if name.starts_with("storey-") {
                assert!(*std < 0.2 / 3.0, "{motion}: {name} has {mean} ± {std}");
                assert!(
                    (mean - 1.0).abs() < 3.3 * std,
                    "{motion}: {name} has {mean} ± {std}"
                );
            }
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_wrong_node_is_excluded_and_the_damaged_storey_named() {
    for seed in ["1", "2", "3"] {
        let site = Site::with(&demo(&[("seed = 1\n", &format!("seed = {seed}\n"))]));
        let record = site.simulate(110.0);
        let _services = site.run();
        let bus = site.join().await;
        let mut tokens = bus
            .watch_live(site.keys().all_live(Service::Fuse))
            .await
            .unwrap();
        within("token of fuse", tokens.some()).await;
        let nodes = bus
            .subscribe::<NodeDisplay>(site.keys().all_nodes(), 1 << 14)
            .await
            .unwrap();
        let alerts = bus
            .subscribe::<AlertMessage>(site.keys().all_alerts(), 1 << 10)
            .await
            .unwrap();
        let events = bus
            .subscribe::<Event>(site.keys().event(), 1 << 10)
            .await
            .unwrap();
        let local = bus
            .subscribe::<LocalMessage>(site.keys().all_local(), 1 << 14)
            .await
            .unwrap();
        let mut reader = EstimateReader::join(&bus, &site.keys()).await;
        site.replay(&record, "max").wait().expect_code(0);
        reader.read_to_end(1).await;

        let mut excluded: BTreeMap<String, (usize, usize)> = BTreeMap::new();
        for (_, node) in nodes.messages().drain() {
            let (left_out, all) = excluded.entry(node.node.to_string()).or_default();
            *left_out += usize::from(node.state == NodeHealth::Excluded);
            *all += 1;
        }
        let share = |name: &str| excluded[name].0 as f64 / excluded[name].1 as f64;
        let healthy = excluded
            .keys()
            .filter(|name| *name != "floor-20")
            .map(|name| share(name))
            .fold(0.0, f64::max);
        println!(
            "seed {seed}: floor-20 left out in {:.2}, a healthy node in at most {healthy:.3}",
            share("floor-20")
        );
        assert!(
            share("floor-20") > 0.5,
            "seed {seed}: {}",
            share("floor-20")
        );
        // A single exclusion of a healthy node costs little. An event would mean that a node is
        // wrong.
        let told: Vec<String> = events
            .messages()
            .drain()
            .filter(|(_, event)| event.kind == EventKind::NodeExcluded)
            .map(|(_, event)| event.subject)
            .collect();
        assert!(
            told.iter().any(|node| node == "floor-20"),
            "seed {seed}: no event names the wrong node"
        );
        assert!(
            told.iter().all(|node| node == "floor-20"),
            "seed {seed}: {told:?}"
        );
        let raised: Vec<String> = alerts
            .messages()
            .drain()
            .filter(|(_, alert)| alert.state == AlertState::Raised)
            .map(|(_, alert)| alert.parameter.to_string())
            .collect();
        println!("seed {seed}: raised {raised:?}");
        assert_eq!(raised, ["storey-1"], "seed {seed}");
        // The station rejects a message with a number that is not finite. No message is missing.
        assert_eq!(local.refused(), BTreeMap::new(), "seed {seed}");
        let mut densities: BTreeMap<String, usize> = BTreeMap::new();
        for (_, message) in local.messages().drain() {
            *densities.entry(message.header.source).or_default() +=
                usize::from(message.density.is_some());
        }
        let nodes = site.structure().nodes().iter();
        let expected = nodes.map(|node| (node.name().to_owned(), 110)).collect();
        assert_eq!(densities, expected, "seed {seed}: densities of each node");
    }
}

/// Nodes must publish the samples rejected by their filters on their topics, including the nodes
/// that end last.
#[tokio::test(flavor = "multi_thread")]
async fn nodes_publish_rejected_samples_and_states_as_in_the_offline_summary() {
    let site = Site::with(&demo(&[]));
    let record = site.simulate(60.0);
    let _services = site.run();
    let bus = site.join().await;
    let mut tokens = bus
        .watch_live(site.keys().all_live(Service::Fuse))
        .await
        .unwrap();
    within("token of fuse", tokens.some()).await;
    let outliers = bus
        .subscribe::<OutlierDisplay>(site.keys().all_outliers(), 1 << 14)
        .await
        .unwrap();
    let nodes = bus
        .subscribe::<NodeDisplay>(site.keys().all_nodes(), 1 << 14)
        .await
        .unwrap();
    let events = bus
        .subscribe::<Event>(site.keys().event(), 1 << 10)
        .await
        .unwrap();
    let mut reader = EstimateReader::join(&bus, &site.keys()).await;
    site.replay(&record, "max").wait().expect_code(0);
    reader.read_to_end(1).await;
    let mut states = BTreeMap::new();
    let all_ended = async {
        while states.len() < 16 || states.values().any(|state| *state != NodeHealth::Ended) {
            let (_, display) = nodes.messages().recv_async().await.unwrap();
            states.insert(display.node.to_string(), display.state);
        }
    };
    within("the end of all nodes", all_ended).await;

    let mut rejected: BTreeMap<String, u64> = BTreeMap::new();
    for (key, display) in outliers.messages().drain() {
        assert!(key.ends_with(display.channel.as_str()), "{key}");
        *rejected.entry(display.channel.to_string()).or_default() += display.flagged;
    }
    assert_eq!(
        rejected.len(),
        32,
        "every channel publishes its rejected samples"
    );
    let mut offline = spandrel("estimate");
    offline
        .arg(site.structure_file())
        .arg("--record")
        .arg(record.path())
        .arg("--json");
    let summary = Process::start(&mut offline).wait().expect_code(0);
    let summary: serde_json::Value = serde_json::from_str(summary.stdout.trim()).unwrap();
    let mut expected: BTreeMap<String, u64> = BTreeMap::new();
    for node in summary["nodes"].as_array().unwrap() {
        expected.extend(
            serde_json::from_value::<BTreeMap<String, u64>>(node["rejected_by_channel"].clone())
                .unwrap(),
        );
    }
    rejected.retain(|_, count| *count > 0);
    assert_eq!(rejected, expected);
    assert!(
        rejected.len() > 25,
        "every two-hundredth of 3000 samples of a channel is a spike: {rejected:?}"
    );

    // The samples of floor 8 are lost from 30 to 45 s.
    let of_floor_8 = events
        .messages()
        .drain()
        .filter(|(_, event)| event.subject == "floor-8");
    let told: Vec<EventKind> = of_floor_8.map(|(_, event)| event.kind).collect();
    assert_eq!(told, [EventKind::NodeSilent, EventKind::NodeBack]);
}

/// The page had neither waveforms nor spectra of nodes with their own filters.
#[tokio::test(flavor = "multi_thread")]
async fn nodes_publish_waveforms_and_spectra_of_their_own_samples() {
    const RATE_HZ: usize = 50;
    /// The first window of 20.48 s has ended before the third spectrum, at 30 s.
    const SECONDS: usize = 31;
    let site = Site::with(&demo(&[]));
    let record = site.simulate(SECONDS as f64);
    let _services = site.run();
    let bus = site.join().await;
    let mut tokens = bus
        .watch_live(site.keys().all_live(Service::Fuse))
        .await
        .unwrap();
    within("token of fuse", tokens.some()).await;
    let node = Name::new("floor-1").unwrap();
    let waveforms = bus
        .subscribe::<WaveformDisplay>(site.keys().waveform(&node), 1 << 10)
        .await
        .unwrap();
    let spectra = bus
        .subscribe::<SpectrumDisplay>(site.keys().spectrum(&node), 1 << 10)
        .await
        .unwrap();
    let mut reader = EstimateReader::join(&bus, &site.keys()).await;
    site.replay(&record, "max").wait().expect_code(0);
    reader.read_to_end(1).await;

    let mut bytes = 0;
    for second in 0..SECONDS - 1 {
        let next = within("a waveform", waveforms.messages().recv_async()).await;
        let (_, waveform) = next.unwrap();
        bytes += waveform.encode().unwrap().len();
        let first = second * RATE_HZ;
        assert_eq!(waveform.time_ns, record.time_ns(first), "second {second}");
        let names: Vec<&str> = waveform
            .channels
            .iter()
            .map(|channel| channel.channel.as_str())
            .collect();
        assert_eq!(names, ["displacement-1", "acceleration-1"]);
        for channel in &waveform.channels {
            assert_eq!(channel.missing, 0, "second {second}");
            for (bucket, ends) in channel.extremes.iter().enumerate() {
                let rows = first + 5 * bucket..first + 5 * (bucket + 1);
                let values = rows.map(|row| record.value(row, channel.channel.as_str()) as f32);
                let least = values.clone().fold(f32::INFINITY, f32::min);
                let largest = values.fold(f32::NEG_INFINITY, f32::max);
                for (found, expected) in ends.unwrap().into_iter().zip([least, largest]) {
                    // Seven significant digits.
                    assert!(
                        (found - expected).abs() <= 1e-6 * expected.abs(),
                        "{} in second {second}: {found}, expected {expected}",
                        channel.channel
                    );
                }
            }
        }
    }
    let mut last = None;
    while last
        .as_ref()
        .is_none_or(|spectrum: &SpectrumDisplay| spectrum.channels[0].windows == 0)
    {
        let next = within("a spectrum", spectra.messages().recv_async()).await;
        let (_, spectrum) = next.unwrap();
        bytes += spectrum.encode().unwrap().len();
        last = Some(spectrum);
    }
    // docs/distributed.md states this limit for a node with two channels.
    let per_second = bytes as f64 / (SECONDS - 1) as f64;
    println!("waveforms and spectra: {per_second:.0} bytes a second");
    assert!(per_second < 2_500.0, "{per_second} bytes a second");
}

/// Without a request, a node sends nothing for display: its link may have little bandwidth.
#[tokio::test(flavor = "multi_thread")]
async fn nodes_publish_no_waveforms_by_default() {
    let site = Site::with(&demo(&[("waveforms = true ", "")]));
    let record = site.simulate(5.0);
    // Ingest would publish waveforms of its own.
    let station = Process::start(&mut site.listening("fuse"));
    station.wait_for_log("ready structures=1");
    let workers = Process::start(&mut site.connecting("identify"));
    workers.wait_for_log("ready structures=1");
    let bus = site.join().await;
    let mut tokens = bus
        .watch_live(site.keys().all_live(Service::Fuse))
        .await
        .unwrap();
    within("token of fuse", tokens.some()).await;
    let node = Name::new("floor-1").unwrap();
    let waveforms = bus
        .subscribe::<WaveformDisplay>(site.keys().waveform(&node), 1 << 10)
        .await
        .unwrap();
    let mut reader = EstimateReader::join(&bus, &site.keys()).await;
    site.replay(&record, "max").wait().expect_code(0);
    reader.read_to_end(1).await;
    assert_eq!(waveforms.messages().drain().count(), 0);
}

/// The demo must report the nodes whose data it falsifies.
#[test]
fn the_demo_ends_with_a_summary_of_its_nodes() {
    let endpoint = crate::support::free_endpoint();
    let mut command = spandrel("demo");
    command.args([
        "--distributed",
        "--headless",
        "--json",
        "--duration",
        "100",
        "--speed",
        "max",
        "--listen",
        &endpoint,
    ]);
    let ended = Process::start(&mut command).wait().expect_code(0);
    let (told, json) = ended
        .stdout
        .trim_end()
        .rsplit_once('\n')
        .expect("events before the summary");
    for part in [
        "floor-8: the node is silent",
        "floor-8: the node sends again",
        "floor-20: the node disagrees",
    ] {
        assert!(told.contains(part), "{part:?} is not in\n{told}");
    }
    let summary: serde_json::Value = serde_json::from_str(json).unwrap();
    let nodes = summary["nodes"].as_array().unwrap();
    assert_eq!(nodes.len(), 16);
    let of = |name: &str| nodes.iter().find(|node| node["node"] == name).unwrap();
    for node in nodes {
        assert!(node["rejected"].as_u64().unwrap() > 0, "spikes of {node}");
        let is_silent = !node["silent"].as_array().unwrap().is_empty();
        assert_eq!(is_silent, node["node"] == "floor-8", "{node}");
    }
    let silence = &of("floor-8")["silent"][0];
    let [from_s, until_s] = ["from_s", "until_s"].map(|key| silence[key].as_f64().unwrap());
    // Times of the fusions, each of which ends its second.
    assert!(
        (29.0..=31.5).contains(&from_s) && (44.0..=46.5).contains(&until_s),
        "{silence}"
    );
    let excluded = |node: &serde_json::Value| node["excluded"].as_u64().unwrap();
    assert!(excluded(of("floor-20")) > 50, "{}", of("floor-20"));
    assert!(
        of("floor-20")["excluded_since_s"].is_number(),
        "{}",
        of("floor-20")
    );
    assert!(
        nodes
            .iter()
            .filter(|node| node["node"] != "floor-20")
            .all(|node| excluded(node) < 20),
        "{nodes:?}"
    );
}

/// A restarted worker must not learn from all samples that its sensor still stores, because the
/// station would count them twice.
#[tokio::test(flavor = "multi_thread")]
async fn a_worker_starts_with_the_current_live_samples() {
    let site = Site::with(&demo(&[]));
    let station = Process::start(&mut site.listening("fuse"));
    station.wait_for_log("ready structures=1");
    let bus = site.join().await;
    let local = bus
        .subscribe::<LocalMessage>(site.keys().all_local(), 1 << 10)
        .await
        .unwrap();
    let buffer = site.keys().buffer(&"floor-1".parse().unwrap());
    let mut sensor = site.connecting("simulate");
    let _sensor = Process::start(sensor.args(["--live", "--node", "floor-1"]));
    // Five seconds of samples are available to a reader that starts at the first one.
    let kept = async {
        while bus
            .stream_position(&buffer, DEADLINE)
            .await
            .is_none_or(|at| at.header.sequence < 250)
        {
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    };
    within("samples of the sensor", kept).await;
    #[expect(
        clippy::disallowed_methods,
        reason = "live samples have wall-clock times"
    )]
    let before_ns = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .unwrap()
        .as_nanos() as i64;
    let _worker = Process::start(site.connecting("identify").args(["--node", "floor-1"]));
    let (_, first) = within("message of the worker", local.messages().recv_async())
        .await
        .unwrap();
    let seconds = (first.header.time_ns - before_ns) as f64 * 1e-9;
    // The first message ends with the first whole second of the clock after the start. With stored
    // samples, this would be seconds earlier.
    assert!(
        seconds > 0.0,
        "the first message is of {seconds:.2} s after the start, and should be of samples after it"
    );
}

#[test]
fn the_error_explains_what_cannot_be_distributed() {
    let folder = tempfile::tempdir().unwrap();
    let run = |subcommand: &str, text: &str, more: &[&str]| {
        let path = folder.path().join("structure.toml");
        std::fs::write(&path, text).unwrap();
        Process::start(spandrel(subcommand).arg(&path).args(more)).wait()
    };
    let centralised = demo(&[("identification = \"distributed\"\n", "")]);
    run("check", &centralised, &[])
        .expect_code(2)
        .expect_told(&["fusion", "identification = \"distributed\""]);
    let endpoint = crate::support::free_endpoint();
    run(
        "identify",
        &demo(&[]),
        &["--node", "floor-7", "--listen", &endpoint],
    )
    .expect_code(2)
    .expect_told(&["floor-7", "floor-8"]);
    run("simulate", &demo(&[]), &["--live", "--node", "floor-7"])
        .expect_code(2)
        .expect_told(&["floor-7", "floor-8"]);
    run("simulate", &demo(&[]), &["--start", "1763730000"])
        .expect_code(2)
        .expect_told(&["--live"]);
    run("check", &demo(&[("rate-hz = 1\n", "rate-hz = 3\n")]), &[])
        .expect_code(2)
        .expect_told(&["fusion.rate-hz", "50"]);
    run(
        "check",
        &demo(&[("motion = \"responses\"", "feedback = \"reset\"")]),
        &[],
    )
    .expect_code(2)
    .expect_told(&["fusion.feedback", "motion = \"modes\""]);
    run(
        "check",
        &demo(&[("rate-hz = 1\n", "rate-hz = 1\nsharing-factor = 0.5\n")]),
        &[],
    )
    .expect_code(2)
    .expect_told(&["fusion.sharing-factor", "from 1"]);
    let five = std::fs::read_to_string(
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples/demo.toml"),
    )
    .unwrap();
    run("fuse", &five, &["--listen", &endpoint])
        .expect_code(2)
        .expect_told(&["nothing to fuse"]);
}
