//! Reduces samples to waveforms and spectra, and publishes them for display.
//!
//! The input is frames: those of a structure, or the samples of one node as frames. The output is
//! the extremes of short buckets once per second, and spectra every 10 s, per node. The reduction
//! runs in a separate task, so no frame waits for a display.
//!
//! - [`NodeChannels`]: the channels of one node, in frame order
//! - [`Displays`]: the task of one structure or node, with its topics
//!
//! A program that needs every sample subscribes to the frames or the samples instead.

mod spectra;
mod waveforms;

mod displays;

pub use displays::Displays;
pub use waveforms::NodeChannels;
