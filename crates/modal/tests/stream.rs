//! A stream gives the same bits however its frames arrive, and after a restart.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that fails panics"
)]

use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use spandrel_modal::{BandLadder, ChannelUse, LadderEpoch, ModalSettings, ModalStream};

const CHANNELS: usize = 3;

/// White noise through a resonance of each channel, sample by sample.
fn frames(count: usize, seed: u64) -> Vec<[f64; CHANNELS]> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut past = [[0.0; 2]; CHANNELS];
    (0..count)
        .map(|_| {
            let shared = random.random_range(-1.0..1.0);
            std::array::from_fn(|channel| {
                let [one, two] = past[channel];
                let rotation = 0.3 + 0.1 * channel as f64; // rad per sample
                let next = 2.0 * 0.98 * f64::cos(rotation) * one - 0.98 * 0.98 * two
                    + shared
                    + random.random_range(-0.3..0.3);
                past[channel] = [next, one];
                next
            })
        })
        .collect()
}

fn settings() -> ModalSettings {
    ModalSettings {
        block_rows: 10,
        highest_order: 12,
        blocks: 8,
        epoch_s: 100.0,
        overlap: 0.5,
        lowest_hz: 0.05,
        ..ModalSettings::new(CHANNELS, 20.0)
    }
}

fn epochs(ladder: &mut BandLadder, frames: &[[f64; CHANNELS]]) -> Vec<LadderEpoch> {
    frames
        .iter()
        .filter_map(|frame| ladder.push(frame).unwrap())
        .collect()
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 12, ..ProptestConfig::default() })]

    /// The state is stored and restored at every boundary of the blocks in which frames arrive.
    #[test]
    fn state_restored_at_any_frame_gives_the_same_bits(
        cuts in prop::collection::vec(1_usize..1500, 1..6),
        seed in 0_u64..1000,
    ) {
        let frames = frames(5000, seed);
        let mut whole = BandLadder::new(&settings()).unwrap();
        let expected = epochs(&mut whole, &frames);
        prop_assert!(expected.len() >= 2);
        let mut ladder = BandLadder::new(&settings()).unwrap();
        let mut found = Vec::new();
        let mut rest = &frames[..];
        for cut in cuts.iter().cycle() {
            let (now, later) = rest.split_at((*cut).min(rest.len()));
            found.extend(epochs(&mut ladder, now));
            let bytes = postcard::to_stdvec(&ladder).unwrap();
            ladder = postcard::from_bytes(&bytes).unwrap();
            rest = later;
            if rest.is_empty() {
                break;
            }
        }
        prop_assert_eq!(&found, &expected);
        let modes = |epochs: &[LadderEpoch]| -> Vec<_> {
            epochs.iter().map(|epoch| epoch.identify().unwrap().modes).collect()
        };
        prop_assert_eq!(modes(&found), modes(&expected));
    }
}

/// The state of a long epoch exceeds that of a short one by at most the partly filled segment of
/// the spectra.
#[test]
fn memory_does_not_grow_with_the_epoch() {
    let size = |epoch_s: f64| {
        let settings = ModalSettings {
            epoch_s,
            ..settings()
        };
        let mut stream = ModalStream::new(&settings).unwrap();
        for frame in frames((epoch_s * 20.0) as usize - 1, 1) {
            stream.push(&frame).unwrap();
        }
        postcard::to_stdvec(&stream).unwrap().len()
    };
    /// Samples of the longest segment, channels and bytes of a value.
    const SEGMENT_BYTES: usize = 1024 * CHANNELS * 8;
    let (short, long) = (size(1000.0), size(10_000.0));
    assert!(long < short + SEGMENT_BYTES, "{short} and {long} bytes");
}

#[test]
fn dead_constant_and_interrupted_channels_are_named_and_left_out() {
    let mut settings = settings();
    settings.channels = 6;
    settings.references = (0..6).collect();
    let mut stream = ModalStream::new(&settings).unwrap();
    let mut found = None;
    for (number, frame) in frames(2100, 3).iter().enumerate() {
        let interrupted = if number % 10 == 0 { f64::NAN } else { frame[0] };
        let frame = [frame[0], frame[1], frame[2], f64::NAN, 9.81, interrupted];
        if let Some(epoch) = stream.push(&frame).unwrap() {
            found = Some(epoch.channels);
            break;
        }
    }
    let found = found.unwrap();
    assert_eq!(found[..3], [ChannelUse::Used; 3]);
    assert_eq!(found[3..5], [ChannelUse::Dead, ChannelUse::Constant]);
    assert!(
        matches!(found[5], ChannelUse::Incomplete { missing } if (missing - 0.1).abs() < 0.01),
        "{:?}",
        found[5]
    );
}

#[test]
fn gap_starts_a_new_epoch() {
    let frames = frames(4000, 5);
    let mut stream = ModalStream::new(&settings()).unwrap();
    for frame in &frames[..1500] {
        assert!(stream.push(frame).unwrap().is_none());
    }
    stream.gap();
    let position = frames[1500..]
        .iter()
        .position(|frame| stream.push(frame).unwrap().is_some());
    // An epoch of 100 s at 20 Hz after the lags of 19 frames, all from after the gap.
    assert_eq!(position, Some(2000 + 19 - 1));
}
