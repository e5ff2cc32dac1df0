//! Messages: the first byte chooses the type, the rest is the payload.

#![no_main]

use libfuzzer_sys::fuzz_target;
use spandrel_bus::{
    Acknowledgement, AlertMessage, Block, CaughtUp, Description, EstimateBlock, Event, FeedbackMessage, FitDisplay,
    FrameBlock, HistoryLog, HistorySpan, LocalMessage, LossDisplay, Message, ModelClassDisplay, NodeDisplay, NoiseDisplay, OutlierDisplay,
    ParameterDisplay, Progress, SampleBlock, StateMessage, Status,
};

/// What decodes is sound, and can be sent on.
fn message<M: Message>(payload: &[u8]) {
    if let Ok(message) = M::decode(&M::encoding(), payload) {
        message.check().expect("a decoded message is sound");
        message.encode().expect("a decoded message can be sent on");
    }
}

/// As [`message`], and does with a block what its readers do.
fn block<B: Block>(payload: &[u8]) {
    message::<B>(payload);
    if let Ok(whole) = B::decode(&B::encoding(), payload) {
        let half = whole.count() / 2;
        let (mut front, mut back) = (whole.clone(), whole);
        front.truncate(half);
        back.skip(half);
        let _ = front.append(&back);
        front.check().expect("a block put together again is sound");
    }
}

const TYPES: [fn(&[u8]); 22] = [
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
    message::<ModelClassDisplay>,
    message::<NodeDisplay>,
    message::<Status>,
    message::<Description>,
    message::<HistorySpan>,
    message::<HistoryLog>,
    message::<StateMessage>,
    message::<FitDisplay>,
    message::<LossDisplay>,
];

fuzz_target!(|bytes: &[u8]| {
    if let Some((which, payload)) = bytes.split_first() {
        TYPES[usize::from(*which) % TYPES.len()](payload);
    }
});
