//! Example systems that no structure file describes.

pub(crate) mod bouc_wen;
pub(crate) mod chain;
#[allow(unreachable_pub, reason = "the tests of the filter use it, too")]
pub(crate) mod drifting;
pub(crate) mod hysteretic;
pub(crate) mod linear;
pub(crate) mod oscillator;

#[allow(
    dead_code,
    unreachable_pub,
    reason = "the tests of the filter use the rest"
)]
pub(crate) mod tall_building;
