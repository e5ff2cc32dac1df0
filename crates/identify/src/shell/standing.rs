//! Leader election among the services that identify the same structure. A service joins, becomes a
//! standby, takes over as the leader, or stops publishing.

use super::{IdentifyService, follow_frames, new_core, start_of};
use crate::error::IdentifyError;
use crate::identification::Identification;
use crate::memory::{Memory, identity};
use crate::seat::{Held, Leading, Seat, StandingBy, next_term};
use spandrel_bus::{
    Claim, Description, EncodeError, EventKind, Forget, Header, Keep, MAX_MESSAGE_BYTES,
    Message as _, NumberedStream, Question, Service, StateMessage, StreamState,
};
use spandrel_checkpoint::Position;
use spandrel_structure::Structure;
use std::sync::Arc;
use std::time::Duration;
use tokio::runtime::Handle;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::task::spawn_blocking;
use tokio::time::Instant;
use tracing::{info, warn};

/// Maximum number of estimates kept for subscribers that have missed some.
pub const ESTIMATES_KEPT: u64 = 32_768;
/// Retention of estimates.
///
/// Estimates that a restarted alert service may need are kept for longer than its restart should
/// take. Their number exceeds the window of a replay. Estimates that it no longer needs are kept
/// for other subscribers, whose links can fail for a while.
const KEEP: Keep = Keep {
    last: ESTIMATES_KEPT,
    needed: Some(Forget {
        at_least: 8_192,
        after: Duration::from_secs(30),
    }),
    released: Some(Forget {
        at_least: 1_024,
        after: Duration::from_secs(15),
    }),
};

/// Capacity of the queue for state queries. Further queries are dropped, and the standby repeats
/// them.
const QUESTIONS_WAITING: usize = 4;
/// Maximum number of states that are sent at once. Each is a copy of up to 8 MiB.
const STATES_AT_ONCE: usize = 2;
/// Time limit for replies about the leader. A slower leader is detected later by its claim.
pub(super) const WHO_LEADS_WITHIN: Duration = Duration::from_millis(500);
/// Time limit for the leader to send its state.
const STATE_WITHIN: Duration = Duration::from_secs(5);
/// Time without activity after which a process may have lost the lead. It then queries the network
/// before it publishes.
const ASLEEP: Duration = Duration::from_millis(1500);

/// Rejects a structure whose state does not fit into one message.
///
/// No process could ever take over from it, and only the log of the standby would report that.
pub(super) fn check_size(
    structure: &Structure,
    core: &Identification,
) -> Result<(), IdentifyError> {
    check_size_of(structure.name(), identity(structure).seal(&core.state())?)
}

fn check_size_of(structure: &str, checkpoint: Vec<u8>) -> Result<(), IdentifyError> {
    // The header has its maximum size.
    let header = Header {
        source: structure.to_owned(),
        epoch: u64::MAX,
        sequence: u64::MAX,
        time_ns: i64::MIN,
    };
    match (StateMessage {
        header,
        term: u64::MAX,
        checkpoint,
    })
    .encode()
    {
        Err(EncodeError::TooLarge { bytes }) => Err(IdentifyError::StateTooLarge {
            structure: structure.to_owned(),
            bytes,
            most: MAX_MESSAGE_BYTES,
        }),
        _ => Ok(()),
    }
}

impl IdentifyService {
    /// Records the highest term that any process has claimed.
    pub(super) fn hear(&mut self, claim: Option<&Claim>) {
        self.heard = self.heard.max(claim.map_or(0, Claim::term));
    }

    /// Acts on the current claims: joins, takes over or steps back.
    pub(super) async fn reconsider(&mut self) -> Result<(), IdentifyError> {
        if !self.has_kept_the_lead().await? {
            return Ok(());
        }
        let leader = self.claims.leading();
        self.hear(leader.as_ref());
        match (&self.seat, leader) {
            (Seat::Leading(own), Some(leader)) if leader > own.claim => {
                self.step_back(leader).await
            }
            (Seat::Leading(_), _) => Ok(()),
            (Seat::StandingBy(own), Some(leader)) if own.in_step_with.as_ref() == Some(&leader) => {
                Ok(())
            }
            (Seat::Joining | Seat::StandingBy(_), Some(leader)) => self.join(&leader).await,
            (Seat::StandingBy(_), None) => self.take_over().await,
            (Seat::Joining, None) => {
                self.begin().await?;
                self.take_over().await
            }
        }
    }

    /// Starts identification from the service's own checkpoint.
    pub(super) async fn begin(&mut self) -> Result<(), IdentifyError> {
        let new = || new_core(&self.structure, &self.id, &self.sensors);
        let core = match &self.memory {
            Some(memory) => memory.recall(new)?,
            None => new()?,
        };
        self.stand_by(core, None).await
    }

    /// Requests the leader's state and continues in step with the leader. If that fails, the next
    /// status tick retries.
    async fn join(&mut self, leader: &Claim) -> Result<(), IdentifyError> {
        let failed = match self.bus.ask_for_state(&self.keys, STATE_WITHIN).await? {
            None => "no reply".to_owned(),
            Some(message) if message.term != leader.term() => "another process replied".to_owned(),
            Some(message) => match identity(&self.structure).open(&message.checkpoint) {
                Err(why) => why.to_string(),
                Ok(state) => {
                    let mut core = new_core(&self.structure, &self.id, &self.sensors)?;
                    match core.restore(state) {
                        Err(why) => why.to_string(),
                        Ok(()) => {
                            info!(structure = self.keys.structure().as_str(), %leader, frame = core.done(), "standing by");
                            self.failed_joins = 0;
                            return self.stand_by(core, Some(leader.clone())).await;
                        }
                    }
                }
            },
        };
        // The process is out of step: its own results differ from those of the leader.
        self.leave();
        self.failed_joins += 1;
        // A process that has just taken over might not reply yet.
        if self.failed_joins > 1 && self.failed_joins.is_power_of_two() {
            let (structure, times) = (self.keys.structure().as_str(), self.failed_joins);
            warn!(structure, %leader, why = failed, times, "cannot stand by: no state from the \
                leader");
        }
        Ok(())
    }

    /// Pauses identification until the process has joined again.
    pub(super) fn leave(&mut self) {
        self.seat = Seat::Joining;
        self.core = None;
        self.frames = None;
    }

    pub(super) async fn stand_by(
        &mut self,
        core: Identification,
        in_step_with: Option<Claim>,
    ) -> Result<(), IdentifyError> {
        // Without a checkpoint, the epoch is set by the first frames.
        let Position { epoch, sequence } = core.position().unwrap_or_default();
        let stream = NumberedStream {
            key: self.keys.estimates(),
            buffer_key: self.keys.estimates_buffer(),
            source: self.id.to_string(),
            epoch,
            first: sequence,
            state: StreamState::Running,
            keep: KEEP,
        };
        let estimates = self.bus.stand_by_numbered(stream).await?;
        self.frames =
            Some(follow_frames(&self.structure, &self.bus, &self.keys, start_of(&core)).await?);
        self.epoch = epoch;
        self.last_time_ns = core.last_time_ns();
        self.core = Some(core);
        self.seat = Seat::StandingBy(StandingBy {
            estimates,
            held: Held::default(),
            in_step_with,
        });
        Ok(())
    }

    /// Takes the lead if frames are available.
    ///
    /// A process that sees neither a leader nor ingest has lost its link. It would only displace a
    /// working leader.
    async fn take_over(&mut self) -> Result<(), IdentifyError> {
        if self.ingest.present().is_empty() {
            return Ok(());
        }
        // When a link fails, the tokens disappear one after the other. The local view of them may
        // be outdated.
        let ingest = self.keys.all_live(Service::Ingest);
        let (ingest, leader) = tokio::join!(
            self.bus.query_tokens(&ingest, WHO_LEADS_WITHIN),
            self.bus.query_leader(&self.keys, WHO_LEADS_WITHIN)
        );
        let leader = leader?;
        self.hear(leader.as_ref());
        if ingest?.is_empty() || leader.is_some() {
            return Ok(()); // the claim will appear or disappear
        }
        self.lead("no other process leads").await
    }

    /// Claims the lead, and leads unless another process makes a higher claim at the same time.
    pub(super) async fn lead(&mut self, why: &str) -> Result<(), IdentifyError> {
        if !matches!(self.seat, Seat::StandingBy(_)) {
            return Ok(());
        }
        let (remembered, former) = (
            self.memory.as_ref().map_or(0, Memory::last_term),
            self.heard,
        );
        let term = next_term(self.clock.epoch(), self.heard, remembered);
        if let Some(memory) = &self.memory {
            memory.keep_term(term);
        }
        let claim = Claim::new(term, self.bus.instance()?);
        let token = self.bus.claim(&self.keys, &claim).await?;
        let highest = self.bus.query_leader(&self.keys, WHO_LEADS_WITHIN).await?;
        if let Some(other) = highest.filter(|other| *other > claim) {
            self.hear(Some(&other));
            return Ok(token.withdraw().await?);
        }
        let description = self.bus.publish_latest(self.keys.description()).await?;
        let (structure, text) = (
            self.keys.structure().clone(),
            self.structure.text().to_owned(),
        );
        description.put(&Description { structure, text }).await?;
        let progress = self
            .bus
            .publish_progress(self.keys.progress(Service::Identify), self.id.to_string())
            .await?;
        let questions = self
            .bus
            .questions(self.keys.state(), QUESTIONS_WAITING)
            .await?;
        let Seat::StandingBy(StandingBy {
            estimates,
            mut held,
            in_step_with,
        }) = std::mem::replace(&mut self.seat, Seat::Joining)
        else {
            return Ok(()); // checked above
        };
        let estimates = estimates.lead(&self.bus, term).await?;
        let led = self.led.latest();
        let position = self.core.as_ref().and_then(Identification::position);
        if let Some(Position { epoch, sequence }) = position {
            let done = led
                .as_ref()
                .filter(|led| led.header.epoch == epoch)
                .map_or(0, |led| led.done);
            estimates.put_again(epoch, done).await?;
            // A source can be waiting for the last progress, which a failed leader was unable to
            // publish.
            progress.set(epoch, sequence, self.last_time_ns.unwrap_or(i64::MIN));
        }
        if let Some(led) = &led {
            held.done(led);
        }
        for output in held.take() {
            self.displays.put(&output).await?;
        }
        self.awake = Instant::now();
        let what = format!("identification is now led by {claim}");
        info!(structure = self.keys.structure().as_str(), %claim, why, frame = position.map(|at| at.sequence), "leads");
        self.seat = Seat::Leading(Leading {
            claim,
            token,
            estimates,
            progress,
            questions,
            replies: Arc::new(Semaphore::new(STATES_AT_ONCE)),
            _description: description,
        });
        if in_step_with.is_some() {
            let why = format!("the leader of term {former} has disappeared");
            self.tell(EventKind::Takeover, what, why).await?;
        }
        Ok(())
    }

    /// Stops publishing because another process leads. Subscribers would reject further messages.
    async fn step_back(&mut self, leader: Claim) -> Result<(), IdentifyError> {
        warn!(structure = self.keys.structure().as_str(), %leader, "superseded: another process \
            leads, this process stops publishing");
        self.hear(Some(&leader));
        self.leave();
        self.join(&leader).await
    }

    /// Returns `true` if the process still leads, or did not lead.
    ///
    /// A leader queries the network after a time without activity.
    pub(super) async fn has_kept_the_lead(&mut self) -> Result<bool, IdentifyError> {
        let slept = self.awake.elapsed() > ASLEEP;
        self.awake = Instant::now();
        let Seat::Leading(own) = &self.seat else {
            return Ok(true);
        };
        if !slept {
            return Ok(true);
        }
        let own = own.claim.clone();
        let highest = self.bus.query_leader(&self.keys, WHO_LEADS_WITHIN).await?;
        self.awake = Instant::now();
        match highest.filter(|other| *other > own) {
            Some(leader) => self.step_back(leader).await.map(|()| false),
            None => Ok(true),
        }
    }

    /// Sends the state to a process that wants to stand by.
    pub(super) fn answer(&self, question: Question, permit: OwnedSemaphorePermit) {
        let (Seat::Leading(leading), Some(core)) = (&self.seat, &self.core) else {
            return;
        };
        let Position { epoch, sequence } = core.position().unwrap_or_default();
        let time_ns = self.last_time_ns.unwrap_or(0);
        let header = Header {
            source: self.id.to_string(),
            epoch,
            sequence,
            time_ns,
        };
        let (state, identity, key, term) = (
            core.state(),
            identity(&self.structure),
            self.keys.state(),
            leading.claim.term(),
        );
        // The state can be megabytes over a slow link. It is therefore sent from a blocking thread,
        // without waiting.
        spawn_blocking(move || {
            let _until_answered = permit;
            let sealed = identity.seal(&state).map_err(|error| error.to_string());
            let answered = async {
                match sealed {
                    Ok(checkpoint) => {
                        question
                            .answer(
                                &key,
                                &StateMessage {
                                    header,
                                    term,
                                    checkpoint,
                                },
                            )
                            .await
                    }
                    Err(why) => {
                        question.refuse(&why).await;
                        Ok(())
                    }
                }
            };
            if let Err(error) = Handle::current().block_on(answered) {
                warn!(%error, "state not sent to a standby");
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn error_names_structure_and_size_limit_of_a_state_too_large() {
        assert!(check_size_of("tower", vec![0; MAX_MESSAGE_BYTES / 2]).is_ok());
        let refused = check_size_of("tower", vec![0; MAX_MESSAGE_BYTES])
            .unwrap_err()
            .to_string();
        assert!(
            refused.contains("tower") && refused.contains("at most 8388608"),
            "{refused}"
        );
    }
}
