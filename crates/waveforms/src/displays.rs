//! Publishes the reduced samples for display, beside the path of the frames.

use spandrel_bus::{
    Block, Bus, BusError, DisplayPublisher, FrameBlock, Keys, SpectrumDisplay, WaveformDisplay,
};
use tokio::task::{JoinHandle, spawn_blocking};
use tracing::warn;

use crate::spectra::Spectra;
use crate::waveforms::{NodeChannels, Waveforms};

/// Number of blocks that wait for the reduction. A further block is dropped and counted, because
/// frames never wait for a display.
const BLOCKS_WAITING: usize = 64;

/// The task that reduces the frames of one structure or node, and publishes the result.
#[derive(Debug)]
pub struct Displays {
    blocks: flume::Sender<FrameBlock>,
    dropped: u64,
    task: JoinHandle<()>,
}

/// What the task needs.
#[derive(Debug)]
struct Reduction {
    waveforms: Waveforms,
    spectra: Spectra,
}

/// The messages of some blocks.
#[derive(Debug, Default)]
struct Messages {
    waveforms: Vec<WaveformDisplay>,
    spectra: Vec<SpectrumDisplay>,
}

/// The topics of one node.
#[derive(Debug)]
struct NodeTopics {
    waveform: DisplayPublisher<WaveformDisplay>,
    spectrum: DisplayPublisher<SpectrumDisplay>,
}

impl Displays {
    /// Declares the topics of `nodes` and starts the task. `nodes` are in frame order, and
    /// `sampling_rate_hz` (Hz) is that of the frames. Without nodes, the task publishes nothing.
    ///
    /// # Errors
    /// Returns an error if the bus rejects a declaration.
    pub async fn start(
        bus: &Bus,
        keys: &Keys,
        nodes: Vec<NodeChannels>,
        sampling_rate_hz: f64,
    ) -> Result<Self, BusError> {
        let mut topics = Vec::new();
        for NodeChannels { node, .. } in &nodes {
            topics.push(NodeTopics {
                waveform: bus.publish_display(keys.waveform(node)).await?,
                spectrum: bus.publish_display(keys.spectrum(node)).await?,
            });
        }
        let structure = keys.structure().clone();
        let reduction = Reduction {
            waveforms: Waveforms::new(structure.clone(), nodes.clone(), sampling_rate_hz),
            spectra: Spectra::new(structure, nodes, sampling_rate_hz),
        };
        let (blocks, waiting) = flume::bounded(BLOCKS_WAITING);
        let structure = keys.structure().to_string();
        let task = tokio::spawn(async move {
            if let Err(why) = publish(&waiting, reduction, &topics).await {
                warn!(
                    structure,
                    why, "no waveforms and spectra until the next start"
                );
            }
        });
        Ok(Self {
            blocks,
            dropped: 0,
            task,
        })
    }

    /// Passes a block to the task, unless its queue is full.
    pub fn offer(&mut self, block: &FrameBlock) {
        if self.blocks.is_full() || self.blocks.try_send(block.clone()).is_err() {
            self.dropped += block.count();
        }
    }

    /// Returns the number of frames that were dropped because the queue was full.
    #[must_use]
    pub fn dropped(&self) -> u64 {
        self.dropped
    }

    /// Publishes what the queue still contains, and ends the task.
    pub async fn close(self) {
        drop(self.blocks);
        // The task logs its own failure, and the panic hook reports a panic.
        drop(self.task.await);
    }
}

/// Reduces blocks until their queue is closed. Returns why it cannot continue.
async fn publish(
    waiting: &flume::Receiver<FrameBlock>,
    mut reduction: Reduction,
    topics: &[NodeTopics],
) -> Result<(), String> {
    let mut is_failing = false;
    while let Ok(block) = waiting.recv_async().await {
        let more = waiting.try_iter().take(BLOCKS_WAITING);
        let blocks: Vec<FrameBlock> = std::iter::once(block).chain(more).collect();
        // The spectra of a hundred channels take milliseconds.
        let reduced = spawn_blocking(move || {
            let mut messages = Messages::default();
            for block in &blocks {
                reduction.reduce(block, &mut messages);
            }
            (reduction, messages)
        });
        let (back, messages) = reduced.await.map_err(|error| error.to_string())?;
        reduction = back;
        // A sample of 1e300 has no place in a message. The next messages may have one.
        let mut failure = None;
        for (message, topics) in messages.waveforms.iter().zip(topics.iter().cycle()) {
            failure = topics.waveform.put(message).await.err().or(failure);
        }
        for (message, topics) in messages.spectra.iter().zip(topics.iter().cycle()) {
            failure = topics.spectrum.put(message).await.err().or(failure);
        }
        match &failure {
            Some(why) if !is_failing => warn!(%why, "a waveform or spectrum is not published"),
            Some(_) | None => {}
        }
        is_failing = failure.is_some();
    }
    Ok(())
}

impl Reduction {
    fn reduce(&mut self, block: &FrameBlock, messages: &mut Messages) {
        self.waveforms.handle(block, &mut messages.waveforms);
        self.spectra.handle(block, &mut messages.spectra);
    }
}
