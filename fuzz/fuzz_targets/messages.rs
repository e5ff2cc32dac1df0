//! Messages: the first byte chooses the type, the rest is the payload.

#![no_main]

use libfuzzer_sys::fuzz_target;
use spandrel_bus::{
    Acknowledgement, AlertMessage, Annotation, Block, CaughtUp, ConditionDisplay, Description, EstimateBlock, Event, FeedbackMessage, FitDisplay, Format, FrameBlock, HistoryLog, HistorySpan, JudgementCourse, JudgementDisplay, LocalMessage, LossDisplay, Maintenance, Message, ModeDisplay, ModelClassDisplay, MonitoringDisplay, NodeDisplay, NoiseDisplay, OutlierDisplay,
    ParameterDisplay, Progress, ReportPage, SampleBlock, SensorHealthDisplay, SpectrumDisplay, StateMessage, Status, WaveformDisplay,
};

/// A decoded message is valid and can be encoded.
fn message<M: Message>(payload: &[u8]) {
    message_in::<M>(M::FORMAT, payload);
}

/// The JSON form of a binary message.
fn text<M: Message>(payload: &[u8]) {
    message_in::<M>(Format::Json, payload);
}

fn message_in<M: Message>(format: Format, payload: &[u8]) {
    if let Ok(message) = M::decode(&M::encoding_as(format), payload) {
        message.check().expect("a decoded message is valid");
        message.encode().expect("a decoded message can be encoded");
    }
}

/// As [`message`], and processes a block as its readers do.
fn block<B: Block>(payload: &[u8]) {
    block_in::<B>(B::FORMAT, payload);
}

/// The JSON form of a block.
fn text_block<B: Block>(payload: &[u8]) {
    block_in::<B>(Format::Json, payload);
}

fn block_in<B: Block>(format: Format, payload: &[u8]) {
    message_in::<B>(format, payload);
    if let Ok(whole) = B::decode(&B::encoding_as(format), payload) {
        let half = whole.count() / 2;
        let (mut front, mut back) = (whole.clone(), whole);
        front.truncate(half);
        back.skip(half);
        let _ = front.append(&back);
        front.check().expect("a block put together again is sound");
    }
}

const TYPES: &[fn(&[u8])] = &[
    block::<SampleBlock>,
    block::<FrameBlock>,
    block::<EstimateBlock>,
    message::<LocalMessage>,
    message::<FeedbackMessage>,
    message::<Progress>,
    message::<CaughtUp>,
    message::<AlertMessage>,
    message::<Acknowledgement>,
    message::<Event>,
    message::<ParameterDisplay>,
    message::<NoiseDisplay>,
    message::<OutlierDisplay>,
    message::<SensorHealthDisplay>,
    message::<ConditionDisplay>,
    message::<ModelClassDisplay>,
    message::<NodeDisplay>,
    message::<Status>,
    message::<Description>,
    message::<HistorySpan>,
    message::<HistoryLog>,
    message::<StateMessage>,
    message::<FitDisplay>,
    message::<LossDisplay>,
    message::<MonitoringDisplay>,
    text_block::<SampleBlock>,
    text::<CaughtUp>,
    message::<Maintenance>,
    message::<JudgementDisplay>,
    message::<JudgementCourse>,
    message::<Annotation>,
    message::<ModeDisplay>,
    message::<WaveformDisplay>,
    message::<SpectrumDisplay>,
    message::<ReportPage>,
];

fuzz_target!(|bytes: &[u8]| {
    if let Some((which, payload)) = bytes.split_first() {
        TYPES[usize::from(*which) % TYPES.len()](payload);
    }
});
