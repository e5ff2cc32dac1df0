//! Messages: the first byte selects the type, the rest is the payload.

use spandrel_bus::{
    Acknowledgement, AlertMessage, Annotation, Block, CaughtUp, ConditionDisplay, Description,
    EpochDisplay, EstimateBlock, Event, FeedbackMessage, FitDisplay, Format, FrameBlock,
    HistoryLog, HistorySpan, JudgementCourse, JudgementDisplay, JudgementLog, LocalMessage,
    LossDisplay, Maintenance, Message, ModeDisplay, ModelClassDisplay, MonitoringDisplay,
    NodeDisplay, NoiseDisplay, OutlierDisplay, ParameterDisplay, Progress, ReportPage, SampleBlock,
    SensorHealthDisplay, SpectrumDisplay, StateMessage, Status, WaveformDisplay,
};

/// Decodes a payload as one type. A decoded message must be valid, and it must be possible to
/// encode it.
pub type Decode = fn(&[u8]) -> Result<(), String>;

fn decode_as<M: Message>(format: Format, payload: &[u8]) -> Result<M, String> {
    let message = M::decode(&M::encoding_as(format), payload).map_err(|error| error.to_string())?;
    message.check().expect("a decoded message is valid");
    message.encode().expect("a decoded message can be encoded");
    Ok(message)
}

/// Decodes a block, and divides and joins it as a reader does.
fn divide<B: Block>(format: Format, payload: &[u8]) -> Result<(), String> {
    let mut front = decode_as::<B>(format, payload)?;
    let mut back = front.clone();
    let half = front.count() / 2;
    front.truncate(half);
    back.skip(half);
    let _ = front.append(&back); // an error if a block is too long
    front.check().expect("the joined block is valid");
    Ok(())
}

fn binary<M: Message>(payload: &[u8]) -> Result<(), String> {
    decode_as::<M>(M::FORMAT, payload).map(drop)
}

/// Decodes the JSON form of a binary message.
fn text<M: Message>(payload: &[u8]) -> Result<(), String> {
    decode_as::<M>(Format::Json, payload).map(drop)
}

fn binary_block<B: Block>(payload: &[u8]) -> Result<(), String> {
    divide::<B>(B::FORMAT, payload)
}

/// Decodes the JSON form of a block.
fn text_block<B: Block>(payload: &[u8]) -> Result<(), String> {
    divide::<B>(Format::Json, payload)
}

/// The types. The first byte of an input is an index into this list.
pub const TYPES: &[Decode] = &[
    binary_block::<SampleBlock>,
    binary_block::<FrameBlock>,
    binary_block::<EstimateBlock>,
    binary::<LocalMessage>,
    binary::<FeedbackMessage>,
    binary::<Progress>,
    binary::<CaughtUp>,
    binary::<AlertMessage>,
    binary::<Acknowledgement>,
    binary::<Event>,
    binary::<ParameterDisplay>,
    binary::<NoiseDisplay>,
    binary::<OutlierDisplay>,
    binary::<SensorHealthDisplay>,
    binary::<ConditionDisplay>,
    binary::<ModelClassDisplay>,
    binary::<NodeDisplay>,
    binary::<Status>,
    binary::<Description>,
    binary::<HistorySpan>,
    binary::<HistoryLog>,
    binary::<StateMessage>,
    binary::<FitDisplay>,
    binary::<LossDisplay>,
    binary::<MonitoringDisplay>,
    text_block::<SampleBlock>,
    text::<CaughtUp>,
    binary::<Maintenance>,
    binary::<JudgementDisplay>,
    binary::<JudgementCourse>,
    binary::<Annotation>,
    binary::<ModeDisplay>,
    binary::<WaveformDisplay>,
    binary::<SpectrumDisplay>,
    binary::<ReportPage>,
    binary::<EpochDisplay>,
    binary::<JudgementLog>,
];

/// Decodes one input. Returns the reason if the message is rejected.
pub fn decode(bytes: &[u8]) -> Result<(), String> {
    let (which, payload) = bytes.split_first().ok_or("no type")?;
    TYPES[usize::from(*which) % TYPES.len()](payload)
}
