//! Damage to the bytes of a file at random places, by defective disks, incomplete copies or
//! deliberate changes.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

/// Seeds of the random numbers, so that every run has the same damage.
pub const SEEDS: [u64; 5] = [1, 2, 3, 4, 5];

/// Returns these bytes with one to four damages.
pub fn damaged(bytes: &[u8], random: &mut ChaCha8Rng) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    for _ in 0..random.random_range(1..=4) {
        damage(&mut bytes, random);
    }
    bytes
}

fn damage(bytes: &mut Vec<u8>, random: &mut ChaCha8Rng) {
    if bytes.is_empty() {
        return;
    }
    let at = random.random_range(0..bytes.len());
    let longest = if random.random_range(0..4) == 0 {
        bytes.len()
    } else {
        64
    };
    let end = (at + random.random_range(1..=longest)).min(bytes.len());
    match random.random_range(0..8) {
        0 | 1 => bytes[at] ^= 1 << random.random_range(0..8),
        2 => bytes.truncate(at),
        3 => drop(bytes.drain(at..end)),
        // A repeated range, after itself or elsewhere.
        4 => drop(bytes.splice(end..end, bytes[at..end].to_vec())),
        5 => {
            let to = random.random_range(0..=bytes.len());
            drop(bytes.splice(to..to, bytes[at..end].to_vec()));
        }
        // A length of eight bytes that is far larger than the data.
        6 => {
            let claim: u64 =
                [u64::MAX, 1 << 40, 1 << 31, bytes.len() as u64][random.random_range(0..4)];
            bytes
                .iter_mut()
                .skip(at)
                .zip(claim.to_le_bytes())
                .for_each(|(byte, of_claim)| *byte = of_claim);
        }
        // Such a length in the minimum number of bytes.
        _ => drop(bytes.splice(
            at..=at,
            [0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0x01],
        )),
    }
}
