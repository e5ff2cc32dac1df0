//! A power failure at any moment: the disk keeps what was synced, and of the rest what chance
//! keeps.
//!
//! One run of all services is logged with every change of the disk
//! ([`DiskLog`](crate::support::DiskLog)). For many moments of this run, the test builds the folder
//! as a disk could hold it after a power failure, starts all services on it on a machine that has
//! booted since, and lets the sensor nodes go on. To see each failure, use `cargo test --workspace
//! --test program power:: -- --nocapture`.

use crate::support::{
    DEADLINE, Disk, DiskLog, Identified, Luck, Process, Record, Sensors, Site, assert_same_bits,
    differences, identified, spandrel, two_storeys, within,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use spandrel_alert::Watch;
use spandrel_bus::{
    AlertMessage, AlertState, Block, Bus, Delivery, EstimateBlock, FrameBlock, Header, HistoryLog,
    HistorySpan, Keys, Name, Service, Start, StreamSettings, StreamState,
};
use spandrel_identify::{Identification, IdentificationInput, Output};
use spandrel_record::LoggedFrames;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tokio::time::Instant;

/// Length of the record (s of measurement time).
const RECORD_S: f64 = 90.0;
/// Rows of a block of the nodes, and the time between two blocks: 15 times real time.
const ROWS: usize = 15;
const EVERY: Duration = Duration::from_millis(10);
/// Interval between two syncs of the recording (s).
const SYNC_S: f64 = 0.25;
/// Delay by which a busy machine may sync too late (s).
const LATE_S: f64 = 2.0;
/// Number of power failures that the test waits for on a busy machine, whatever its limit.
const AT_LEAST: usize = 3;
/// Time between two looks at a condition that has no event.
const LOOK_EVERY: Duration = Duration::from_millis(50);

/// Returns a building with an alert in the middle of the record, whose storeys are judged.
fn building() -> String {
    two_storeys(&format!(
        "[[alert]]\nparameters = \"all\"\nreference.design-std = 1e-9\nloss = 0.05\n\
         credibility = 0.99\nsustain-s = 3\n\
         [[simulation.damage]]\nparameter = \"storey-2\"\nat-s = {}\nloss = 0.15\n\
         [judge]\nepoch-s = 5\n\
         [[judge.quantity]]\nname = \"storey-1\"\nis = \"stiffness\"\n\
         [[judge.condition]]\nname = \"deck\"\nunit = \"degC\"\n",
        RECORD_S / 3.0
    ))
}

/// Returns the command that runs all services with their state in `state`.
fn services(site: &Site, state: &Path) -> Command {
    let configuration = site.folder().join("spandrel.toml");
    let text = format!(
        "[state]\nfolder = \"{0}\"\ncheckpoint-s = 1\n\
         [state.recording]\nsync-s = {SYNC_S}\nsegment-s = 20\n\
         [history]\ndatabase = \"{0}/history.sqlite\"\n",
        state.display()
    );
    std::fs::write(&configuration, text).unwrap();
    let mut command = site.connecting("run");
    command.arg("--config").arg(configuration);
    command.args(["--http", "none"]);
    command
}

/// The folder of a structure's files below the folder of the state.
fn folder_of(keys: &Keys, state: &Path) -> PathBuf {
    state
        .join(keys.root().as_str())
        .join(keys.structure().as_str())
}

/// Something that left the machine, with the length of the log at that time: a disk that holds this
/// much of the log must hold the reason.
struct Heard<T> {
    at: usize,
    what: T,
}

/// A run whose changes of the disk are known.
struct Story {
    log: DiskLog,
    /// Number of rows that the nodes had published.
    rows: Vec<Heard<usize>>,
    /// Epoch of the frames that had been published, and the number of the next one.
    frames: Vec<Heard<(u64, u64)>>,
    alerts: Vec<Heard<AlertMessage>>,
}

impl Story {
    /// Runs all services once, from an empty disk to an orderly stop.
    async fn of(disk: &Disk, site: &Site, record: &Record) -> Self {
        let (bus, keys) = (site.host().await, site.keys());
        let mut sensors = Sensors::start(&bus, &keys, site.structure(), record).await;
        let frames = bus
            .subscribe::<FrameBlock>(keys.frames(), 1 << 14)
            .await
            .unwrap();
        let alerts = bus
            .subscribe::<AlertMessage>(keys.all_alerts(), 1 << 14)
            .await
            .unwrap();
        let mut command = services(site, &disk.path().join("state"));
        disk.watch(&mut command);
        let process = Process::start(&mut command);
        process.wait_for_log("ready structures=1");
        let mut story = Self {
            log: disk.read(),
            rows: Vec::new(),
            frames: Vec::new(),
            alerts: Vec::new(),
        };
        let mut decided = bus
            .watch_progress(keys.progress(Service::Alert))
            .await
            .unwrap();
        let ending = put(&mut sensors, 0..record.len(), true, |rows| {
            story.rows.push(Heard {
                at: disk.now(),
                what: rows,
            });
        });
        let listening = async {
            let all = record.len() as u64;
            let finished = decided.wait_for(|progress| progress.done >= all);
            tokio::pin!(finished);
            loop {
                tokio::select! {
                    Ok((_, block)) = frames.messages().recv_async() => {
                        story.frames.push(Heard { at: disk.now(), what: (block.header.epoch, block.end()) });
                    }
                    Ok((_, alert)) = alerts.messages().recv_async() => {
                        story.alerts.push(Heard { at: disk.now(), what: alert });
                    }
                    _ = &mut finished => break,
                }
            }
        };
        within("the last decision", async {
            tokio::join!(ending, listening)
        })
        .await;
        process.stop().expect_code(0);
        bus.close().await.unwrap();
        story.log = disk.read();
        story
    }

    /// Returns the last of these that left the machine before a record of the log.
    fn last<'a, T>(&self, heard: &'a [Heard<T>], moment: usize) -> Option<&'a T> {
        let length = self.length(moment);
        let known = heard.partition_point(|heard| heard.at <= length);
        known.checked_sub(1).map(|last| &heard[last].what)
    }

    /// Returns the length of the log after its first `moment` records.
    fn length(&self, moment: usize) -> usize {
        moment
            .checked_sub(1)
            .map_or(0, |last| self.log.moments()[last].end)
    }

    /// Draws a moment. Every second one is just before or after a sync or a change of names.
    fn any_moment(&self, random: &mut ChaCha8Rng) -> usize {
        let moments = self.log.moments();
        if random.random_bool(0.5) {
            return random.random_range(1..=moments.len());
        }
        let orders: Vec<usize> = (0..moments.len())
            .filter(|at| moments[*at].is_order)
            .collect();
        orders[random.random_range(0..orders.len())] + random.random_range(0..2)
    }
}

/// Publishes rows at the pace of the test, and ends the stream if they are the last.
async fn put(
    sensors: &mut Sensors,
    rows: std::ops::Range<usize>,
    is_paced: bool,
    mut done: impl FnMut(usize),
) {
    let names: Vec<String> = sensors.names();
    let end = sensors.record().len();
    let mut next = rows.start;
    while next < rows.end {
        let block = next..(next + ROWS).min(rows.end);
        next = block.end;
        let state = if next == end {
            StreamState::Ended
        } else {
            StreamState::Running
        };
        for name in &names {
            sensors
                .put_changed(name, block.clone(), |block| block.state = state)
                .await;
        }
        done(next);
        if is_paced {
            tokio::time::sleep(EVERY).await;
        }
    }
}

/// What a power failure has cost.
#[derive(Debug, Default)]
struct Cost {
    /// Frames that were published and are not on the disk (s of the clock of the machine).
    frames_s: f64,
    /// Longest gap in the history (s of measurement time).
    history_s: f64,
}

/// Lets the power fail at a moment and checks everything that the services promise.
async fn fail(
    story: &Story,
    site: &Site,
    disk: &Disk,
    record: &Record,
    moment: usize,
    luck: Luck,
    random: &mut ChaCha8Rng,
) -> Cost {
    let again = Site::with(&building()).rooted(site.keys().root().as_str());
    let keys = again.keys();
    story.log.rebuild(moment, luck, random, again.folder());
    let state = again.folder().join("state");
    let decided_before = checkpoints(&folder_of(&keys, &state), "alert").pop_last();
    let resumed = resumes_at(&folder_of(&keys, &state));

    // The nodes have not failed. They hold what they have measured.
    let bus = again.host().await;
    let mut sensors = Sensors::start(&bus, &keys, again.structure(), record).await;
    let measured = story.last(&story.rows, moment).copied().unwrap_or(0);
    put(&mut sensors, 0..measured, false, |_| {}).await;
    let start = match resumed {
        Some((epoch, sequence)) => Start::At { epoch, sequence },
        None => Start::Beginning,
    };
    let settings = StreamSettings::new(start).patient();
    let estimates = bus
        .follow::<EstimateBlock>(keys.estimates(), keys.estimates_buffer(), settings)
        .await
        .unwrap();
    // The reader must not fall behind, because the services keep only the last estimates.
    let found = Arc::new(Mutex::new(Vec::new()));
    let (read, into) = (estimates.deliveries().clone(), found.clone());
    tokio::spawn(async move {
        while let Ok(delivery) = read.recv_async().await {
            // Frames that the disk has lost have no estimates.
            if let Delivery::Block(block) = delivery {
                into.lock().unwrap().push(block);
            }
        }
    });
    let mut command = services(&again, &state);
    disk.restart_machine(&mut command);
    let process = Process::start(&mut command);
    process.wait_for_log("ready structures=1");
    let mut decided = bus
        .watch_progress(keys.progress(Service::Alert))
        .await
        .unwrap();
    put(&mut sensors, measured..record.len(), false, |_| {}).await;
    let end_ns = record.time_ns(record.len() - 1);
    let finished = decided.wait_for(|progress| progress.header.time_ns >= end_ns);
    within("the last decision", finished).await;
    let decided = decided.latest().unwrap();
    let end = (decided.header.epoch, decided.done);

    let known = stored_changes(&bus, &keys).await;
    let span = stored_values(&bus, &keys, end_ns).await;
    let is_read = || {
        let found = found.lock().unwrap();
        let read = found.last().map(|block| (block.header.epoch, block.end()));
        // If all frames were identified before the failure, no estimates follow.
        read.max(resumed).is_some_and(|read| read >= end)
    };
    within("the last estimates", async {
        while !is_read() {
            tokio::time::sleep(LOOK_EVERY).await;
        }
    })
    .await;
    process.stop().expect_code(0);
    bus.close().await.unwrap();
    let aside = files_that_were_set_aside(&state);
    assert!(aside.is_empty(), "set aside: {aside:?}");

    // The recording.
    let runs = recorded(&again, &folder_of(&keys, &state).join("recording"));
    let frames_s = check_recording(story, record, &again, &runs, moment);

    // The estimates: from the first frame that identify had not seen, or from the new epoch.
    let seen = seen_by_identify(record, &again, &runs, resumed);
    let (expected_estimates, expected_alerts) = expected(&again, &seen);
    let first = resumed.unwrap_or((seen.last().unwrap().epoch, 0));
    let found = std::mem::take(&mut *found.lock().unwrap());
    let mut compared = BTreeSet::new();
    for block in found {
        let epoch = block.header.epoch;
        for (number, found) in (block.header.sequence..).zip(identified(&block)) {
            let expected = expected_estimates.get(&(epoch, number));
            let expected = expected.unwrap_or_else(|| {
                panic!(
                    "estimate {number} of epoch {epoch}, resumed at {resumed:?}: {:?}",
                    spans(&runs)
                )
            });
            let names: Vec<String> = Vec::new();
            assert_same_bits(
                &format!("estimate {number} of epoch {epoch}, resumed at {resumed:?}"),
                &names,
                std::slice::from_ref(expected),
                &[found],
            );
            compared.insert((epoch, number));
        }
    }
    let missing = expected_estimates
        .range(first..)
        .find(|(place, _)| !compared.contains(place));
    assert!(
        missing.is_none() && compared.first().is_none_or(|place| *place >= first),
        "estimates from {:?}, not from {first:?}; the first missing one is {missing:?}",
        compared.first()
    );

    // The alerts: what somebody has heard is known, and nothing is raised twice.
    let is_change = |alert: &&AlertMessage| alert.state != AlertState::Normal;
    let heard: Vec<&AlertMessage> = story
        .alerts
        .iter()
        .filter(|heard| heard.at <= story.length(moment))
        .map(|heard| &heard.what)
        .filter(is_change)
        .collect();
    let brief = |alert: &AlertMessage| (alert.parameter.to_string(), alert.state, alert.since_ns);
    let mut known: Vec<_> = known.iter().filter(is_change).map(brief).collect();
    for alert in heard {
        assert!(
            known.contains(&brief(alert)),
            "{alert:?} was heard and is not among {known:?}"
        );
    }
    let raised = known
        .iter()
        .filter(|(_, state, _)| *state == AlertState::Raised)
        .count();
    assert_eq!(raised, 1, "{known:?}");
    let expected: Vec<_> = expected_alerts
        .iter()
        .filter(|alert| is_change(alert))
        .map(brief)
        .collect();
    // Alert may have decided about estimates of frames that the disk has lost. If its checkpoint
    // has not kept such a decision, the history may have kept it.
    if decided_before
        .is_none_or(|(epoch, number)| expected_estimates.contains_key(&(epoch, number.max(1) - 1)))
    {
        let before: Vec<_> = story
            .alerts
            .iter()
            .map(|heard| brief(&heard.what))
            .collect();
        known.retain(|alert| expected.contains(alert) || !before.contains(alert));
        assert_eq!(known, expected, "changes of alerts");
    }
    let longest = span
        .rows
        .time_s
        .windows(2)
        .map(|pair| pair[1] - pair[0])
        .fold(0.0, f64::max);
    Cost {
        frames_s,
        history_s: longest,
    }
}

/// Returns the positions of the checkpoints of a service.
fn checkpoints(folder: &Path, service: &str) -> BTreeSet<(u64, u64)> {
    let place = |name: &str| {
        let numbers = name.strip_prefix(service)?.strip_suffix(".checkpoint")?;
        let (epoch, number) = numbers.strip_prefix('-')?.split_once('-')?;
        Some((epoch.parse().ok()?, number.parse().ok()?))
    };
    let files = std::fs::read_dir(folder.join("checkpoints"));
    let names = files
        .into_iter()
        .flatten()
        .map(|file| file.unwrap().file_name());
    names
        .filter_map(|name| place(name.to_str().unwrap()))
        .collect()
}

/// Returns the first frame that identify will process, or `None` if it will begin with the new
/// epoch.
///
/// Identify restores its oldest checkpoint, which is the earliest one that alert may need. Before
/// the first decision, this is the state before the first frame, in epoch 0.
fn resumes_at(folder: &Path) -> Option<(u64, u64)> {
    let oldest = checkpoints(folder, "identify").pop_first();
    oldest.filter(|(epoch, _)| *epoch > 0)
}

/// Returns the frames from which the results of identify follow.
///
/// A resumed state contains all earlier frames of its epoch, whether or not the recording has kept
/// them. Without a checkpoint, identify processes only the new epoch.
fn seen_by_identify(
    record: &Record,
    site: &Site,
    runs: &[LoggedFrames],
    resumed: Option<(u64, u64)>,
) -> Vec<LoggedFrames> {
    let last = runs.last().unwrap();
    let Some((epoch, next)) = resumed else {
        let is_new = |run: &&LoggedFrames| run.epoch == last.epoch;
        return runs.iter().filter(is_new).cloned().collect();
    };
    let channels = site.structure().channels();
    let channels: Vec<&str> = channels.map(|channel| channel.name()).collect();
    let row = |row: usize| channels.iter().map(move |name| record.value(row, name));
    let former = LoggedFrames {
        epoch,
        sequence: 0,
        t0_ns: record.time_ns(0),
        values: (0..next as usize).flat_map(row).collect(),
        ended: false,
        ..last.clone()
    };
    let later = runs.iter().filter_map(|run| {
        let known = match run.epoch == epoch {
            true => next.saturating_sub(run.sequence).min(run.count()),
            false => 0,
        };
        let mut rest = run.clone();
        rest.values.drain(..known as usize * channels.len());
        rest.sequence += known;
        (rest.count() > 0).then_some(rest)
    });
    std::iter::once(former).chain(later).collect()
}

/// Returns the changes of alerts, once alert and history agree on them.
async fn stored_changes(bus: &Bus, keys: &Keys) -> Vec<AlertMessage> {
    let ask = async |key: &str| -> Vec<AlertMessage> {
        let logs = bus.ask::<HistoryLog>(key, DEADLINE).await.unwrap();
        logs.into_iter().flat_map(|(_, log)| log.alerts).collect()
    };
    let of_history = format!("{}?points=1000", keys.history_log());
    let started = Instant::now();
    loop {
        let (decided, stored) = (ask(&keys.alert_log()).await, ask(&of_history).await);
        let is_stored = |alert: &AlertMessage| {
            let same = |other: &AlertMessage| {
                (&other.parameter, other.state, other.since_ns)
                    == (&alert.parameter, alert.state, alert.since_ns)
            };
            let of_part =
                |other: &&AlertMessage| other.parameter == alert.parameter && other.revision == 0;
            let changes: Vec<&AlertMessage> = stored.iter().filter(of_part).collect();
            // A raised alert can be unconfirmed, and raised again. Nothing is raised twice in a
            // row.
            let is_repeated = |pair: &[&AlertMessage]| pair.iter().all(|other| same(other));
            let repeated = changes.windows(2).any(is_repeated);
            assert!(alert.since_ns.is_none() || !repeated, "{stored:?}");
            stored.iter().any(same)
        };
        let is_change = |alert: &&AlertMessage| alert.state != AlertState::Normal;
        if decided.iter().filter(is_change).all(is_stored) {
            return decided;
        }
        assert!(
            started.elapsed() < DEADLINE,
            "alert: {decided:?}\nhistory: {stored:?}"
        );
        tokio::time::sleep(LOOK_EVERY).await;
    }
}

/// Returns the values of a parameter in the history, once the last one is stored.
async fn stored_values(bus: &Bus, keys: &Keys, end_ns: i64) -> HistorySpan {
    let key = format!(
        "{}?points=20000",
        keys.history(&Name::new("storey-2").unwrap())
    );
    let end_s = end_ns as f64 * 1e-9 - 0.5;
    within("the last value in the history", async {
        loop {
            let spans = bus.ask::<HistorySpan>(&key, DEADLINE).await.unwrap();
            let is_whole = |span: &HistorySpan| span.rows.time_s.last().is_some_and(|t| *t > end_s);
            if let Some((_, span)) = spans.into_iter().find(|(_, span)| is_whole(span)) {
                return span;
            }
            tokio::time::sleep(LOOK_EVERY).await;
        }
    })
    .await
}

/// Returns the files that a service could not use. Only of the recording, a file that was never
/// synced may be unreadable.
fn files_that_were_set_aside(state: &Path) -> Vec<PathBuf> {
    let mut open = vec![state.to_owned()];
    let mut found = Vec::new();
    while let Some(folder) = open.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_name().unwrap().to_str().unwrap();
            if name.contains("refused")
                || name.contains("corrupt")
                || name.starts_with("judge-epochs.1")
            {
                found.push(path.clone());
            }
            if path.is_dir() {
                open.push(path);
            }
        }
    }
    found
}

/// Reads all recorded frames, a block for each run without a gap.
fn recorded(site: &Site, folder: &Path) -> Vec<LoggedFrames> {
    let log = site.frame_log(folder);
    let reader = log.reader();
    let mut runs: Vec<LoggedFrames> = Vec::new();
    for span in reader.spans() {
        let mut after = span.from;
        while after < span.to {
            let frames = reader
                .read(span.epoch, after, 1000, 1 << 20)
                .unwrap()
                .unwrap();
            after = frames.sequence + frames.count();
            match runs.last_mut() {
                Some(run)
                    if run.epoch == span.epoch && run.sequence + run.count() == frames.sequence =>
                {
                    run.values.extend(&frames.values);
                    run.ended |= frames.ended;
                }
                _ => runs.push(frames),
            }
        }
    }
    runs
}

/// Checks that the recording contains the record, in order and nothing twice, except frames that
/// were not synced long enough before. Returns the age of the oldest published frame that it lacks
/// (s).
fn check_recording(
    story: &Story,
    record: &Record,
    site: &Site,
    runs: &[LoggedFrames],
    moment: usize,
) -> f64 {
    let channels: Vec<String> = site
        .structure()
        .channels()
        .map(|channel| channel.name().to_owned())
        .collect();
    let mut next = 0;
    let mut holes = Vec::new();
    let mut before = None;
    for run in runs {
        let first = run.t0_ns + run.sequence as i64 * 10_000_000;
        let row = (0..record.len()).find(|row| record.time_ns(*row) == first);
        let row = row.expect("a frame at a time of the record");
        assert!(
            row >= next,
            "rows {row} to {next} are recorded twice: {:?}",
            spans(runs)
        );
        // Within an epoch, the end of a segment can be lost although the next one is there.
        assert!(
            row == next || before == Some(run.epoch),
            "samples are lost although their nodes hold them: {:?}",
            spans(runs)
        );
        holes.extend(next..row);
        for (offset, values) in run.values.chunks_exact(channels.len()).enumerate() {
            for (value, channel) in values.iter().zip(&channels) {
                let expected = record.value(row + offset, channel);
                let number = row + offset;
                assert_eq!(
                    value.to_bits(),
                    expected.to_bits(),
                    "{channel}, row {number}"
                );
            }
        }
        next = row + run.count() as usize;
        before = Some(run.epoch);
    }
    assert_eq!(next, record.len(), "{:?}", spans(runs));

    // Frames that had left the machine and are not on the disk. Those at the end come again.
    let epoch = story.frames.first().map(|heard| heard.what.0);
    let former = runs.iter().filter(|run| Some(run.epoch) == epoch);
    let end = former
        .map(|run| run.sequence + run.count())
        .max()
        .unwrap_or(0);
    let now = story.log.moments()[moment.max(1) - 1].time_s;
    let is_lost = |heard: &&Heard<(u64, u64)>| {
        let mut rows = holes.iter().filter(|row| heard.what.1 > **row as u64);
        heard.at <= story.length(moment) && (heard.what.1 > end || rows.next().is_some())
    };
    let oldest = story.frames.iter().find(is_lost).map_or(0.0, |heard| {
        let moments = story.log.moments();
        let at = moments.partition_point(|moment| moment.end < heard.at);
        now - moments.get(at).map_or(now, |moment| moment.time_s)
    });
    assert!(
        oldest <= SYNC_S + LATE_S,
        "a frame of {oldest} s ago is lost"
    );
    oldest
}

fn spans(runs: &[LoggedFrames]) -> Vec<(u64, i64, u64, u64)> {
    runs.iter()
        .map(|run| (run.epoch, run.t0_ns, run.sequence, run.count()))
        .collect()
}

/// Returns the results of the cores for the recorded frames, without services.
fn expected(
    site: &Site,
    runs: &[LoggedFrames],
) -> (BTreeMap<(u64, u64), Identified>, Vec<AlertMessage>) {
    let structure = site.structure();
    let mut core = Identification::new(structure, "identify").unwrap();
    let mut watch = Watch::new(structure, None).unwrap();
    let (mut estimates, mut alerts) = (BTreeMap::new(), Vec::new());
    let mut before: Option<&LoggedFrames> = None;
    for run in runs {
        let mut outputs = Vec::new();
        let is_apart =
            |before: &&LoggedFrames| before.epoch == run.epoch && before.end() < run.sequence;
        if let Some(before) = before.filter(is_apart) {
            let gap = IdentificationInput::gap(before.sequence + before.count(), run.sequence);
            core.handle(gap, &mut outputs);
        }
        before = Some(run);
        let block = FrameBlock {
            header: Header {
                source: "ingest".into(),
                epoch: run.epoch,
                sequence: run.sequence,
                time_ns: 0,
            },
            t0_ns: run.t0_ns,
            sampling_rate_hz: run.sampling_rate_hz,
            channels: run.channels,
            values: run.values.clone(),
            state: if run.ended {
                StreamState::Ended
            } else {
                StreamState::Running
            },
        };
        core.handle(IdentificationInput::Frames(block), &mut outputs);
        for output in outputs {
            if let Output::Estimates(block) = output {
                let numbered = (block.header.sequence..).zip(identified(&block));
                estimates.extend(numbered.map(|(number, found)| ((run.epoch, number), found)));
                watch.handle_block(&block, &mut alerts).unwrap();
            }
        }
    }
    let name = |name: &str| Name::new(name).unwrap();
    let message = |alert: &spandrel_alert::Alert| {
        let parameter = name(structure.parameters()[alert.parameter].name());
        alert.to_message(&name(structure.name()), &parameter)
    };
    let alerts = alerts
        .iter()
        .filter(|alert| alert.revision == 0)
        .map(message)
        .collect();
    (estimates, alerts)
}

/// Lets the power fail at `moments` moments of one run, within `limit`. With `forgets`, files with
/// this ending count as never synced.
async fn fails_at_random_moments(
    moments: usize,
    limit: Duration,
    seed: u64,
    forgets: Option<&str>,
) {
    let folder = tempfile::tempdir().unwrap();
    let Some(disk) = Disk::or_skip(folder.path()) else {
        return;
    };
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let site = Site::with(&building());
    let record = site.simulate(RECORD_S);
    let started = Instant::now();
    let mut story = Story::of(&disk, &site, &record).await;
    println!("ran for {:?}", started.elapsed());

    // The log is complete: without loss, it gives the folder as it is.
    let whole = folder.path().join("whole");
    story
        .log
        .rebuild(story.log.moments().len(), Luck::ALL, &mut random, &whole);
    let differing = differences(&disk.path(), &whole);
    assert!(differing.is_empty(), "{differing:#?}");
    let raised = story
        .alerts
        .iter()
        .filter(|heard| heard.what.state == AlertState::Raised && heard.what.revision == 0)
        .count();
    assert_eq!(raised, 1, "the run has one alert to lose");

    if let Some(ending) = forgets {
        story.log.forget_syncs(ending);
    }
    let (started, mut failures) = (Instant::now(), 0);
    let mut worst = Cost::default();
    while failures < moments && (failures < AT_LEAST || started.elapsed() < limit) {
        let (moment, luck) = (story.any_moment(&mut random), Luck::any(&mut random));
        let before = &story.log.moments()[moment - 1];
        println!(
            "{failures}: after record {moment} of {} ({}), {luck:?}",
            story.log.moments().len(),
            before.what
        );
        let cost = fail(&story, &site, &disk, &record, moment, luck, &mut random).await;
        println!("   {cost:?}");
        worst.frames_s = worst.frames_s.max(cost.frames_s);
        worst.history_s = worst.history_s.max(cost.history_s);
        failures += 1;
    }
    println!(
        "seed {seed}: {failures} power failures in a run of {} records; worst {worst:?}",
        story.log.moments().len()
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn a_power_failure_loses_only_what_was_not_synced() {
    fails_at_random_moments(12, Duration::from_secs(30), 1, None).await;
}

/// Shows that the test above can fail.
#[tokio::test(flavor = "multi_thread")]
#[should_panic(expected = "set aside")]
async fn checkpoints_without_a_sync_would_be_noticed() {
    fails_at_random_moments(12, Duration::from_secs(60), 1, Some(".new")).await;
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "takes minutes: the long form of the test above"]
async fn hundreds_of_power_failures_lose_only_what_was_not_synced() {
    for seed in [1, 2, 3] {
        fails_at_random_moments(100, Duration::from_secs(3600), seed, None).await;
    }
}

/// A command that has ended has promised its files. A new token replaces the file of the first one.
#[test]
fn tokens_and_certificates_survive_a_power_failure_after_the_command() {
    let folder = tempfile::tempdir().unwrap();
    let Some(disk) = Disk::or_skip(folder.path()) else {
        return;
    };
    let site = disk.path().join("site");
    let structure = folder.path().join("house.toml");
    std::fs::write(&structure, building()).unwrap();
    let [tokens, site, structure] = [&disk.path().join("tokens.json"), &site, &structure]
        .map(|path| path.to_str().unwrap().to_owned());
    let commands: [(&str, &[&str]); 6] = [
        ("token", &["ada", "--role", "viewer", "--file", &tokens]),
        ("token", &["grace", "--role", "operator", "--file", &tokens]),
        ("site", &["create", &site]),
        (
            "site",
            &["issue", &site, "router", "main", "--host", "127.0.0.1"],
        ),
        ("site", &["nodes", &site, &structure]),
        (
            "site",
            &[
                "router",
                &site,
                &structure,
                "--listen",
                "quic/127.0.0.1:7447",
            ],
        ),
    ];
    for (subcommand, arguments) in commands {
        let mut command = spandrel(subcommand);
        disk.watch(command.args(arguments));
        Process::start(&mut command).wait().expect_code(0);
    }
    let nothing_else = Luck {
        data: 0.0,
        names: 0.0,
        grows: false,
        sector: 512,
    };
    let (log, after) = (disk.read(), folder.path().join("after"));
    let mut random = ChaCha8Rng::seed_from_u64(1);
    log.rebuild(log.moments().len(), nothing_else, &mut random, &after);
    let differing = differences(&disk.path(), &after);
    assert!(differing.is_empty(), "{differing:#?}");
}
