//! Converts the frames of a frame log to channels of a recording.

use std::collections::BTreeMap;

use crate::fault::Fault;
use crate::frame_log::{StatedLayout, decode_frames, frame_time_ns};
use crate::recorded::{RecordedChannel, TimeOrigin};

/// Frames of one or more segments, in reading order.
#[derive(Debug, Default)]
pub(crate) struct FrameRows {
    names: Vec<String>,
    rate_hz: f64,
    times_ns: Vec<i64>,
    /// Values by channel.
    columns: Vec<Vec<f64>>,
}

impl FrameRows {
    /// Reads the layout from the metadata of a segment. All segments must have the same channels
    /// and sampling rate.
    pub(crate) fn take_layout(&mut self, metadata: &BTreeMap<String, String>) -> Result<(), Fault> {
        let stated = StatedLayout::from_metadata(metadata).ok_or_else(|| {
            Fault::of_file(
                "metadata of the frames",
                format!("{metadata:?}"),
                "that of a frame log",
            )
        })?;
        let layout = stated.layout;
        if self.names.is_empty() {
            self.columns = vec![Vec::new(); layout.channels.len()];
            (self.names, self.rate_hz) = (layout.channels, layout.sampling_rate_hz);
            return Ok(());
        }
        if (&layout.channels, layout.sampling_rate_hz) != (&self.names, self.rate_hz) {
            let told =
                |names: &[String], rate_hz: f64| format!("{} at {rate_hz} Hz", names.join(", "));
            let found = told(&layout.channels, layout.sampling_rate_hz);
            return Err(Fault::of_file(
                "channels of the frames",
                found,
                told(&self.names, self.rate_hz),
            ));
        }
        Ok(())
    }

    /// Decodes the frames of a message that ends at byte `place`.
    pub(crate) fn take(&mut self, place: usize, message: &[u8]) -> Result<(), Fault> {
        let refused = |found: String| {
            Fault::at_byte(
                place,
                "preceding message of frames",
                found,
                "as specified by its schema",
            )
        };
        let block = decode_frames(message)
            .ok_or_else(|| refused(format!("{} bytes long", message.len())))?;
        if usize::from(block.channels) != self.columns.len() {
            return Err(refused(format!("one of {} channels", block.channels)));
        }
        for (number, row) in
            (block.sequence..).zip(block.values.chunks_exact(self.columns.len().max(1)))
        {
            self.times_ns
                .push(frame_time_ns(block.t0_ns, block.sampling_rate_hz, number));
            for (column, value) in self.columns.iter_mut().zip(row) {
                column.push(*value);
            }
        }
        Ok(())
    }

    /// Returns the channels in time order, and remarks for the user.
    ///
    /// If two frames are not more than half a step apart, the first one counts. Such frames occur
    /// when epochs overlap and cover the same time twice.
    pub(crate) fn channels(self) -> (Vec<RecordedChannel>, Vec<String>) {
        let Self {
            names,
            rate_hz,
            times_ns,
            columns,
        } = self;
        let half_step_ns = (0.5e9 / rate_hz) as i64;
        let mut order: Vec<usize> = (0..times_ns.len()).collect();
        // The stable sort keeps the reading order of simultaneous frames.
        order.sort_by_key(|row| times_ns[*row]);
        let mut last_ns: Option<i64> = None;
        order.retain(|row| {
            let is_apart =
                last_ns.is_none_or(|last_ns| times_ns[*row].saturating_sub(last_ns) > half_step_ns);
            last_ns = if is_apart {
                Some(times_ns[*row])
            } else {
                last_ns
            };
            is_apart
        });
        let mut remarks = Vec::new();
        if order.len() < times_ns.len() {
            let left_out = times_ns.len() - order.len();
            remarks.push(format!(
                "{left_out} frames have the time of another frame and are skipped"
            ));
        }
        let sorted_ns: Vec<i64> = order.iter().map(|row| times_ns[*row]).collect();
        let channel = |(name, column): (String, Vec<f64>)| {
            let values: Vec<f64> = order.iter().map(|row| column[*row]).collect();
            RecordedChannel::from_times(name, Some(rate_hz), &sorted_ns, &values)
                .with_origin(TimeOrigin::Epoch)
        };
        (
            names.into_iter().zip(columns).map(channel).collect(),
            remarks,
        )
    }
}
