//! `spandrel earthquake`: a bridge, a simulated hysteretic building, and recordings with mistakes.

use crate::support::records_or_skip;
use rand::{RngExt as _, SeedableRng};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

fn earthquake(structure: &Path, records: &[PathBuf], report: &Path) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_spandrel"));
    command.arg("earthquake").arg(structure).args(records);
    command.arg("--report").arg(report).output().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Returns the reports of a folder, by the name of their recordings.
fn reports(folder: &Path) -> BTreeMap<String, Value> {
    let files = std::fs::read_dir(folder).unwrap();
    let paths = files.map(|file| file.unwrap().path());
    let json = paths.filter(|path| {
        path.extension()
            .is_some_and(|extension| extension == "json")
    });
    json.map(|path| {
        let report: Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
        assert!(path.with_extension("html").exists(), "{}", path.display());
        (report["record"].as_str().unwrap().to_owned(), report)
    })
    .collect()
}

/// Returns the judgement of the first stiffness of a report.
fn judgement(report: &Value) -> &Value {
    &report["parameters"][0]["judgement"]
}

fn softened(report: &Value) -> bool {
    judgement(report)["softening"]["is_raised"] == true
}

/// Returns the lasting losses of a report that are raised.
fn raised(report: &Value) -> Vec<&Value> {
    let all = judgement(report)["lasting"].as_array().unwrap().iter();
    all.filter(|candidate| candidate["loss"]["is_raised"] == true)
        .collect()
}

/// The figures of all earthquakes of the bridge are those of the case `judge.painter`.
#[test]
fn bridge_is_reported_in_the_order_of_time_and_archives_without_its_ground_are_named() {
    let Some(records) = records_or_skip("painter-street-bridge") else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let structure = root().join("docs/examples/earthquake/highway-bridge.toml");
    // Against the order of time: the dates sort them. The last one lacks the motion of the ground.
    let archives = [
        "bayview_11oct2013_72086051_ce89324p.zip",
        "petrolia_25apr1992_ce89324p.zip",
        "petrolia91_ce89324p.zip",
    ];
    let paths = archives.map(|name| records.join(name));
    let output = earthquake(&structure, &paths, folder.path());
    let (stdout, stderr) = (text(&output.stdout), text(&output.stderr));
    assert_eq!(output.status.code(), Some(2), "{stderr}");
    for part in [
        "1 of 3 recordings cannot be reported",
        "has no channel `channel-3.acceleration`",
    ] {
        assert!(stderr.contains(part), "{part}\n{stderr}");
    }
    assert_eq!(stdout.lines().count(), 2);
    let reports = reports(folder.path());
    let found = archives[..2].iter().map(|name| {
        let report = &reports[*name];
        (
            report["number"].as_u64().unwrap(),
            report["start"].as_str().unwrap(),
        )
    });
    // The recorder had a clock of low quality; the archive states the time of the earthquake only.
    let expected = [(2, "2013-10-11T23:05:59Z"), (1, "1992-04-25T18:06Z")];
    assert_eq!(found.collect::<Vec<_>>(), expected);
}

/// Masses (kg), stiffness of each storey (N/m) and damping ratio of the simulated building.
const MASS: f64 = 1e5;
const STIFFNESS: f64 = 8e7;
const DAMPING: f64 = 0.03;
pub const RATE_HZ: f64 = 100.0;
pub const FLOORS: usize = 3;

/// Structure file of the building, as its owner would write it: linear.
pub fn building() -> String {
    let mut text = format!(
        "[structure]\nname = \"block-7\"\nsampling-rate-hz = {RATE_HZ}\n\n[model]\n\
         kind = \"shear-building\"\nmasses-kg = [{MASS}, {MASS}, {MASS}]\n\
         stiffnesses-n-per-m = [{STIFFNESS}, {STIFFNESS}, {STIFFNESS}]\n\n[damping]\n\
         kind = \"rayleigh\"\nratio = {DAMPING}\nmodes = [1, 2]\n\n[[excitation]]\n\
         name = \"ground\"\nkind = \"ground\"\nstd = 0.3\nmeasured-on = \"ground\"\n\n\
         [[node]]\nname = \"recorder\"\n\n[[node.channel]]\nname = \"ground\"\n\
         quantity = \"ground-acceleration\"\nunit = \"m/s2\"\nnoise-std = 0.001\n"
    );
    for floor in 1..=FLOORS {
        text += &format!(
            "\n[[node.channel]]\nname = \"floor-{floor}\"\nquantity = \"absolute-acceleration\"\n\
             dof = {floor}\nunit = \"m/s2\"\nnoise-std = 0.01\nnoise-group = \"floors\"\n\
             adapt-noise = true\n\n[[parameter]]\nname = \"storey-{floor}\"\n\
             scales = \"stiffness\"\n\
             of = [\"storey-{floor}\"]\nstd = 0.3\n"
        );
    }
    text + "\n[record]\ntime-column = \"time\"\n"
}

/// Simulates an earthquake by Runge-Kutta of fourth order with four steps per sample.
///
/// The first storey yields: its force is α k r + (1 − α) k z, with the hysteretic displacement
/// ż = ṙ − |ṙ||z|² z/(2 r_y³) − ṙ|z|³/(2 r_y³) (Bouc-Wen with n = 3).
fn quake(seed: u64, peak: f64, first_storey: f64) -> Vec<[f64; FLOORS + 1]> {
    const SECONDS: usize = 60;
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    let frames = SECONDS * RATE_HZ as usize;
    let (mut level, mut ground) = (0.0, Vec::with_capacity(frames));
    for frame in 0..frames {
        let time_s = frame as f64 / RATE_HZ;
        let envelope = match time_s {
            t if t < 8.0 => 0.001,
            t if t < 11.0 => (t - 8.0) / 3.0,
            t if t < 17.0 => 1.0,
            t => (-(t - 17.0) / 7.0).exp(),
        };
        level = 0.75 * level + random.random_range(-1.0..1.0);
        ground.push(envelope * level);
    }
    let largest = ground.iter().fold(0.0_f64, |most, a| most.max(a.abs()));
    ground.iter_mut().for_each(|a| *a *= peak / largest);
    respond(&ground, first_storey, &mut random)
}

/// Returns the samples of the ground and of each floor under this motion of the ground.
pub fn respond(
    ground: &[f64],
    first_storey: f64,
    random: &mut rand_chacha::ChaCha8Rng,
) -> Vec<[f64; FLOORS + 1]> {
    const PARTS: u32 = 4;
    const YIELD_M: f64 = 0.003;
    const ALPHA: f64 = 0.1;
    let springs = [first_storey * STIFFNESS, STIFFNESS, STIFFNESS];
    // Proportional to stiffness, with the ratio at the first frequency of 2 Hz.
    let viscous = springs.map(|k| 2.0 * DAMPING / (std::f64::consts::TAU * 2.0) * k);
    let slope = |a: f64, y: &[f64; 7]| {
        let (x, v, z) = (&y[..3], &y[3..6], y[6]);
        let drift = [x[0], x[1] - x[0], x[2] - x[1]];
        let speed = [v[0], v[1] - v[0], v[2] - v[1]];
        let mut force = [0.0; 3];
        for storey in 0..3 {
            let spring = match storey {
                0 => springs[0] * (ALPHA * drift[0] + (1.0 - ALPHA) * z),
                _ => springs[storey] * drift[storey],
            };
            force[storey] = spring + viscous[storey] * speed[storey];
        }
        let yielding = z.abs().powi(2) / (2.0 * YIELD_M.powi(3));
        let z_rate = speed[0] - speed[0].abs() * yielding * z - speed[0] * yielding * z.abs();
        [
            v[0],
            v[1],
            v[2],
            (force[1] - force[0]) / MASS - a,
            (force[2] - force[1]) / MASS - a,
            -force[2] / MASS - a,
            z_rate,
        ]
    };
    let step = 1.0 / (RATE_HZ * f64::from(PARTS));
    let (mut y, mut rows) = ([0.0; 7], Vec::with_capacity(ground.len()));
    for (frame, a) in ground.iter().enumerate() {
        let next = ground.get(frame + 1).unwrap_or(a);
        let accelerations = slope(*a, &y);
        let mut noise = |std: f64| std * random.random_range(-1.7..1.7);
        rows.push([
            a + noise(0.0005),
            accelerations[3] + a + noise(0.001),
            accelerations[4] + a + noise(0.001),
            accelerations[5] + a + noise(0.001),
        ]);
        for part in 0..PARTS {
            let at = |share: f64| a + (next - a) * (f64::from(part) + share) / f64::from(PARTS);
            let plus = |k: &[f64; 7], h: f64| {
                let mut moved = y;
                moved.iter_mut().zip(k).for_each(|(y, k)| *y += h * k);
                moved
            };
            let k1 = slope(at(0.0), &y);
            let k2 = slope(at(0.5), &plus(&k1, 0.5 * step));
            let k3 = slope(at(0.5), &plus(&k2, 0.5 * step));
            let k4 = slope(at(1.0), &plus(&k3, step));
            for row in 0..7 {
                y[row] += step / 6.0 * (k1[row] + 2.0 * k2[row] + 2.0 * k3[row] + k4[row]);
            }
        }
    }
    rows
}

/// Writes the recordings of a building whose first storey has these stiffnesses, event by event,
/// and returns their reports in the order of time.
fn simulated_events(folder: &Path, events: &[(f64, f64)]) -> Vec<Value> {
    events_of(folder, &building(), events)
}

/// Like [`simulated_events`], with this structure file of the building.
fn events_of(folder: &Path, file: &str, events: &[(f64, f64)]) -> Vec<Value> {
    let structure = folder.join("block-7.toml");
    std::fs::write(&structure, file).unwrap();
    let mut paths = Vec::new();
    for (index, (peak, first_storey)) in events.iter().enumerate() {
        let start_s = 1_600_000_000 + 2_592_000 * index;
        let mut table = "time,ground,floor-1,floor-2,floor-3\n".to_owned();
        for (frame, row) in quake(7 + index as u64, *peak, *first_storey)
            .iter()
            .enumerate()
        {
            let time_s = frame as f64 / RATE_HZ;
            let values: Vec<String> = row.iter().map(|value| format!("{value:.6}")).collect();
            table += &format!(
                "{}.{:02},{}\n",
                start_s + frame / 100,
                frame % 100,
                values.join(",")
            );
            assert!(time_s < 60.0);
        }
        let path = folder.join(format!("event-{index:02}.csv"));
        std::fs::write(&path, table).unwrap();
        paths.push(path);
    }
    let output = earthquake(&structure, &paths, &folder.join("reports"));
    println!("{}", text(&output.stdout));
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let mut reports: Vec<Value> = reports(&folder.join("reports")).into_values().collect();
    reports.sort_by_key(|report| report["start"].as_str().unwrap().to_owned());
    reports
}

/// Peak of the ground (m/s²) of a weak and of a strong event.
const WEAK: f64 = 0.15;
const STRONG: f64 = 6.0;

#[test]
fn yielding_building_softens_in_motion_and_loses_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let peaks = [
        WEAK, WEAK, WEAK, WEAK, WEAK, STRONG, WEAK, STRONG, WEAK, WEAK,
    ];
    let reports = simulated_events(folder.path(), &peaks.map(|peak| (peak, 1.0)));
    for (index, report) in reports.iter().enumerate() {
        assert!(
            raised(report).is_empty(),
            "event {index}: {:?}",
            raised(report)
        );
        let is_strong = peaks[index] > 1.0;
        assert_eq!(
            softened(report),
            is_strong,
            "event {index}: {}",
            report["headline"]
        );
    }
    let second = &judgement(&reports[7])["softening"]["expected"];
    assert_eq!(second["is_as_expected"], true, "{second}");
    // The drifts of the three storeys are stated.
    assert_eq!(reports[5]["responses"].as_array().unwrap().len(), FLOORS);
}

#[test]
fn building_that_loses_a_storey_for_good_is_found_from_weak_motion() {
    const LEFT: f64 = 0.5;
    let folder = tempfile::tempdir().unwrap();
    let sound = [WEAK; 6].map(|peak| (peak, 1.0));
    let damaged = [STRONG, WEAK, WEAK, WEAK].map(|peak| (peak, LEFT));
    let events: Vec<(f64, f64)> = sound.into_iter().chain(damaged).collect();
    let reports = simulated_events(folder.path(), &events);
    assert!(reports[..6].iter().all(|report| raised(report).is_empty()));
    let last = &reports[9];
    let loss = raised(last)[0];
    assert_eq!(loss["since"], 6, "{loss}");
    assert_eq!(last["urgency"], "inspect-first");
    // The first frequency of the chain falls as that of its first mode: k of the whole structure.
    let frequency = |first: f64| lowest_eigenvalue(first);
    let truth = 1.0 - frequency(LEFT) / frequency(1.0);
    let (low, high) = (
        loss["loss"]["interval"]["low"].as_f64().unwrap(),
        loss["loss"]["interval"]["high"].as_f64().unwrap(),
    );
    assert!((low..=high).contains(&truth), "{truth}: {low} to {high}");
}

#[test]
fn unpredicted_stiffness_in_weak_motion_is_the_headline_also_without_strong_shaking() {
    let folder = tempfile::tempdir().unwrap();
    let sound = [WEAK; 5].map(|peak| (peak, 1.0));
    let events: Vec<(f64, f64)> = sound.into_iter().chain([(WEAK, 0.5)]).collect();
    let reports = simulated_events(folder.path(), &events);
    let headline = |index: usize| reports[index]["headline"].as_str().unwrap();
    let urgency = |index: usize| reports[index]["urgency"].as_str().unwrap();
    // Three earlier events are required for a prediction.
    for (index, found) in ["0 earlier events", "1 earlier event ", "2 earlier events"]
        .into_iter()
        .enumerate()
    {
        let text = headline(index);
        assert!(text.contains("Nothing is judged: "), "{text}");
        assert!(
            text.contains(found) && text.contains("3 are required"),
            "{text}"
        );
        assert!(!text.contains("no sign of change"), "{text}");
        let reasons = reports[index]["not_judged"].to_string();
        assert!(reasons.contains(found), "{reasons}");
    }
    for index in [3, 4] {
        let text = headline(index);
        assert!(text.contains("no sign of change"), "{text}");
        assert_eq!(urgency(index), "no-action", "{text}");
    }
    let text = headline(5);
    assert!(
        text.starts_with("In weak motion, the stiffness of "),
        "{text}"
    );
    assert!(text.contains(" of nominal, below the "), "{text}");
    assert!(text.ends_with("Inspect this structure."), "{text}");
    assert!(!text.contains("no sign of change"), "{text}");
    assert_eq!((urgency(5), &reports[5]["rank"]), ("inspect", &2.into()));
    // The list ranks the structure by this report.
    let list = std::fs::read_to_string(folder.path().join("reports/index.html")).unwrap();
    let first = &list[..list.find("</tr>\n").unwrap()];
    assert!(
        first.contains("<span class=\"badge u2\">inspect</span>"),
        "{first}"
    );
}

#[test]
fn alert_that_is_raised_in_weak_motion_is_the_headline() {
    let folder = tempfile::tempdir().unwrap();
    let rule = "\n[[alert]]\nparameters = [\"storey-1\"]\nloss = 0.1\ncredibility = 0.99\n\
                sustain-s = 2\nreference = { design-std = 0.05 }\n";
    let file = building() + rule;
    let reports = events_of(folder.path(), &file, &[(WEAK, 0.5)]);
    let text = reports[0]["headline"].as_str().unwrap();
    assert!(
        text.starts_with("An alert is raised: storey-1 has lost "),
        "{text}"
    );
    assert_eq!(reports[0]["urgency"], "inspect", "{text}");
    assert!(!text.contains("no sign of change"), "{text}");
}

/// Returns the lowest root of det(K − λM) of the chain, in units of k/m, by bisection of the sign
/// of the Sturm sequence.
fn lowest_eigenvalue(first_storey: f64) -> f64 {
    let diagonal = [first_storey + 1.0, 2.0, 1.0];
    let has_below = |lambda: f64| {
        let mut pivot = diagonal[0] - lambda;
        let mut negative = pivot < 0.0;
        for entry in &diagonal[1..] {
            pivot = entry - lambda - 1.0 / pivot;
            negative |= pivot < 0.0;
        }
        negative
    };
    let (mut low, mut high) = (0.0, 2.0);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if has_below(middle) {
            high = middle;
        } else {
            low = middle;
        }
    }
    low
}

#[test]
fn mistakes_are_named_with_their_file_and_exit_code_2() {
    let folder = tempfile::tempdir().unwrap();
    let structure = folder.path().join("block-7.toml");
    std::fs::write(&structure, building()).unwrap();
    let record = folder.path().join("event.csv");
    std::fs::write(&record, "time,ground,floor-1\n0.00,0.1,0.1\n0.01,0.1,0.1\n").unwrap();
    let missing = folder.path().join("missing.csv");
    for (path, told) in [
        (&record, &["event.csv", "floor-2"][..]),
        (&missing, &["missing.csv", "No such file"]),
    ] {
        let output = earthquake(
            &structure,
            std::slice::from_ref(path),
            &folder.path().join("reports"),
        );
        assert_eq!(output.status.code(), Some(2));
        let stderr = text(&output.stderr);
        assert!(told.iter().all(|part| stderr.contains(part)), "{stderr}");
    }
    // Without a date, a recording cannot be sorted among those with dates.
    let records = [
        (1_600_000_000, "later"),
        (1_500_000_000, "earlier"),
        (0, "undated"),
    ];
    let records = records.map(|(start_s, name)| {
        let path = folder.path().join(format!("{name}.csv"));
        let mut table = "time,ground,floor-1,floor-2,floor-3\n".to_owned();
        for frame in 0..200 {
            let time_s = f64::from(start_s) + f64::from(frame) / RATE_HZ;
            table += &format!("{time_s:.2},0.0,0.0,0.0,0.0\n");
        }
        std::fs::write(&path, table).unwrap();
        path
    });
    let output = earthquake(&structure, &records, &folder.path().join("reports"));
    let stderr = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{stderr}");
    for part in [
        "later.csv (starts at 2020-",
        "earlier.csv (starts at 2017-",
        "undated.csv has no date",
    ] {
        assert!(stderr.contains(part), "{part}: {stderr}");
    }
    assert!(
        !folder.path().join("reports").exists(),
        "nothing is written without a report"
    );
}
