//! A vibrating structure for tests.

use spandrel_bus::{FrameBlock, Header, Name, StreamState};
use spandrel_modal::ModalSettings;
use spandrel_structure::{DeclaredMode, ModalPlan};

pub(crate) const RATE_HZ: f64 = 20.0;
/// Length of an epoch (s).
pub(crate) const EPOCH_S: f64 = 160.0;
/// Number of channels of a frame. The first one is not used.
pub(crate) const CHANNELS: usize = 3;

pub(crate) fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

/// Returns a plan that declares modes with their frequencies (Hz).
pub(crate) fn plan(modes: &[(&str, f64)]) -> ModalPlan {
    let declared = modes.iter().map(|(name, frequency_hz)| DeclaredMode {
        name: (*name).to_owned(),
        frequency_hz: *frequency_hz,
        within: ModalPlan::WITHIN,
    });
    ModalPlan {
        settings: ModalSettings {
            epoch_s: EPOCH_S,
            ..ModalSettings::new(CHANNELS - 1, RATE_HZ)
        },
        has_band: true,
        channels: (1..CHANNELS).collect(),
        names: vec!["floor-1".to_owned(), "floor-2".to_owned()],
        modes: declared.collect(),
        update: None,
    }
}

/// Returns frames of a structure with modes at 1 and 2.5 Hz under a random force.
pub(crate) fn frames(count: usize) -> Vec<[f64; CHANNELS]> {
    frames_of([1.0, 2.5], count)
}

/// Returns frames of a structure with two modes (Hz) under a random force.
pub(crate) fn frames_of(modes_hz: [f64; 2], count: usize) -> Vec<[f64; CHANNELS]> {
    let mut noise = 1_u32;
    let mut random = move || {
        noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        f64::from(noise) / f64::from(u32::MAX) - 0.5
    };
    let mut motion = [[0.0; 2]; 2];
    let mut frame = || {
        let force = random();
        for (state, frequency_hz) in motion.iter_mut().zip(modes_hz) {
            let rotation = std::f64::consts::TAU * frequency_hz / RATE_HZ;
            let next = 2.0 * 0.99 * rotation.cos() * state[0] - 0.99 * 0.99 * state[1] + force;
            *state = [next, state[0]];
        }
        let [[first, _], [second, _]] = motion;
        [random(), first + second, first - second]
    };
    (0..count).map(|_| frame()).collect()
}

/// Returns frames from number `first` on as a block of the run `epoch`.
pub(crate) fn block(epoch: u64, first: usize, frames: &[[f64; CHANNELS]]) -> FrameBlock {
    FrameBlock {
        header: Header {
            source: "ingest".into(),
            epoch,
            sequence: first as u64,
            time_ns: 0,
        },
        t0_ns: t0_ns(epoch),
        sampling_rate_hz: RATE_HZ,
        channels: CHANNELS as u16,
        values: frames.iter().flatten().copied().collect(),
        state: StreamState::Running,
    }
}

/// Returns the time of frame 0 of a run (ns).
pub(crate) fn t0_ns(epoch: u64) -> i64 {
    1_000_000_000_000 * epoch as i64
}
