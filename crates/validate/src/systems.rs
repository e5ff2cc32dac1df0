//! Example systems that no structure file describes.

pub(crate) mod bouc_wen;
pub(crate) mod chain;
pub(crate) mod drifting;
pub(crate) mod hysteretic;
pub(crate) mod linear;
pub(crate) mod oscillator;
pub(crate) mod tall_building;
