//! Encodes and decodes the message of a segment: a block of frames.

use super::{LoggedFrames, NodePosition};

/// Name of the message schema.
pub(crate) const SCHEMA_NAME: &str = "spandrel.frames";
/// Encoding of the schema: text for readers.
pub(super) const SCHEMA_ENCODING: &str = "text/plain";
/// Encoding of messages. Another layout requires another name.
pub(crate) const MESSAGE_ENCODING: &str = "spandrel.frames.v1";
/// Description of the message layout.
pub(super) const SCHEMA: &str = "\
Consecutive frames of one epoch: one value per channel and frame. All numbers are little-endian.

byte  type  what
   0  u64   epoch
   8  u64   number of the first frame
  16  i64   time of frame 0 of the epoch, ns since 1970, UTC
  24  f64   sampling rate, Hz
  32  u32   F, frames
  36  u16   C, values of a frame
  38  u16   N, positions of nodes: 0, or one per node
  40  u16   S, bytes of the source
  42  u8    1 if the epoch ends with these frames, otherwise 0
  43  u8    0
  44  S bytes                source, UTF-8
      N times (u64, u64, u64)  epoch and number of the next sample of each node after these \
      frames; 1 if there is none
      F times C times f64    frame after frame, NaN = missing

Frame k was measured at the time of frame 0 + round(k * 10^9 / rate) ns. The log time of the \
message is that of its first
frame, or 0 before 1970. The metadata of the channel names structure, channels and nodes, in this \
order.
";

/// Size of the head before the source, in bytes.
const HEAD_BYTES: usize = 44;

/// Encodes frames as a message into `bytes`, replacing its content. The counts must have been
/// checked.
pub(super) fn encode_to(frames: &LoggedFrames, bytes: &mut Vec<u8>) {
    bytes.clear();
    bytes.reserve(
        HEAD_BYTES + frames.source.len() + 24 * frames.nodes.len() + 8 * frames.values.len(),
    );
    bytes.extend(frames.epoch.to_le_bytes());
    bytes.extend(frames.sequence.to_le_bytes());
    bytes.extend(frames.t0_ns.to_le_bytes());
    bytes.extend(frames.sampling_rate_hz.to_le_bytes());
    bytes.extend((frames.count() as u32).to_le_bytes());
    bytes.extend(frames.channels.to_le_bytes());
    bytes.extend((frames.nodes.len() as u16).to_le_bytes());
    bytes.extend((frames.source.len() as u16).to_le_bytes());
    bytes.extend([u8::from(frames.ended), 0]);
    bytes.extend(frames.source.as_bytes());
    for node in &frames.nodes {
        bytes.extend(node.epoch.to_le_bytes());
        bytes.extend(node.sequence.to_le_bytes());
        bytes.extend(u64::from(node.ended).to_le_bytes());
    }
    bytes.extend(frames.values.iter().flat_map(|value| value.to_le_bytes()));
}

/// Decodes the frames of a message. Returns `None` if the message is invalid.
pub(crate) fn decode(bytes: &[u8]) -> Option<LoggedFrames> {
    let mut rest = bytes;
    let epoch = u64::from_le_bytes(take(&mut rest)?);
    let sequence = u64::from_le_bytes(take(&mut rest)?);
    let t0_ns = i64::from_le_bytes(take(&mut rest)?);
    let sampling_rate_hz = f64::from_le_bytes(take(&mut rest)?);
    let frames = u32::from_le_bytes(take(&mut rest)?);
    let channels = u16::from_le_bytes(take(&mut rest)?);
    let nodes = u16::from_le_bytes(take(&mut rest)?);
    let source_bytes = u16::from_le_bytes(take(&mut rest)?);
    let ended = match take(&mut rest)? {
        [0, 0] => false,
        [1, 0] => true,
        _ => return None,
    };
    let (source, rest) = rest.split_at_checked(usize::from(source_bytes))?;
    let source = std::str::from_utf8(source).ok()?.to_owned();
    let (positions, values) = rest.split_at_checked(24 * usize::from(nodes))?;
    let expected = u64::from(frames).checked_mul(8 * u64::from(channels))?;
    let is_sound = values.len() as u64 == expected
        && (channels > 0 || frames == 0)
        && sampling_rate_hz.is_finite()
        && sampling_rate_hz > 0.0
        && sequence.checked_add(u64::from(frames)).is_some();
    if !is_sound {
        return None;
    }
    let (values, _) = values.as_chunks::<8>();
    let values = values
        .iter()
        .map(|value| f64::from_le_bytes(*value))
        .collect();
    let (numbers, _) = positions.as_chunks::<8>();
    let numbers: Vec<u64> = numbers
        .iter()
        .map(|number| u64::from_le_bytes(*number))
        .collect();
    let (positions, _) = numbers.as_chunks::<3>();
    let position = |[epoch, sequence, ended]: &[u64; 3]| NodePosition {
        epoch: *epoch,
        sequence: *sequence,
        ended: *ended != 0,
    };
    let nodes = positions.iter().map(position).collect();
    Some(LoggedFrames {
        source,
        epoch,
        sequence,
        t0_ns,
        sampling_rate_hz,
        channels,
        values,
        ended,
        nodes,
    })
}

/// Takes the next `N` bytes of a message.
fn take<const N: usize>(rest: &mut &[u8]) -> Option<[u8; N]> {
    let (first, after) = rest.split_first_chunk::<N>()?;
    *rest = after;
    Some(*first)
}
