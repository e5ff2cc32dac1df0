//! Where the service stands among others that identify the same structure: it joins, stands by, takes over, steps back.

use super::{IdentifyService, follow_frames, now_ns, start_of};
use crate::error::IdentifyError;
use crate::identification::Identification;
use crate::memory::{Memory, identity};
use crate::seat::{Held, Leading, Seat, StandingBy, next_term};
use spandrel_bus::{
    Claim, Description, EncodeError, EventKind, Forget, Header, Keep, MAX_MESSAGE_BYTES,
    Message as _, NumberedStream, Question, Service, StateMessage, StreamState,
};
use spandrel_structure::Structure;
use std::time::Duration;
use tokio::runtime::Handle;
use tokio::task::spawn_blocking;
use tokio::time::Instant;
use tracing::{info, warn};

/// Estimates kept for readers that missed some, at most.
pub const ESTIMATES_KEPT: u64 = 32_768;
/// Those that alert may need, if it is started again, are kept for longer than it should take, and are more than the window of a replay;
/// what it needs no more stays for other readers, whose links may fail for a while.
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

/// Questions for the state that wait; one more is not heard, and asked again.
const QUESTIONS_WAITING: usize = 4;
/// Time for the network to say who leads; whoever is silent for longer is heard of by his claim.
pub(super) const WHO_LEADS_WITHIN: Duration = Duration::from_millis(500);
/// Time for the one that leads to give its state.
const STATE_WITHIN: Duration = Duration::from_secs(5);
/// A process that was not awake for this long may have lost the lead meanwhile: it asks before it puts anything.
const ASLEEP: Duration = Duration::from_millis(1500);

/// Refuses a structure whose state does not fit one message: nobody could ever take it over, and who stands by would be told so only
/// by the log.
pub(super) fn check_size(
    structure: &Structure,
    core: &Identification,
) -> Result<(), IdentifyError> {
    check_size_of(structure.name(), identity(structure).seal(&core.state())?)
}

fn check_size_of(structure: &str, checkpoint: Vec<u8>) -> Result<(), IdentifyError> {
    // as large as numbers get
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
    /// Notes the highest term of which anybody has told.
    pub(super) fn hear(&mut self, claim: Option<&Claim>) {
        self.heard = self.heard.max(claim.map_or(0, Claim::term));
    }

    /// Goes by who claims to lead: joins, takes over or steps back.
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

    /// Takes what this service remembers itself, to identify from there on.
    pub(super) async fn begin(&mut self) -> Result<(), IdentifyError> {
        let new = || Identification::new(&self.structure, self.id.as_str());
        let core = match &self.memory {
            Some(memory) => memory.recall(new)?,
            None => new()?,
        };
        self.stand_by(core, None).await
    }

    /// Asks the one that leads for its state, and identifies the same from there on. Where that fails it is tried again with the next
    /// status.
    async fn join(&mut self, leader: &Claim) -> Result<(), IdentifyError> {
        let failed = match self.bus.ask_for_state(&self.keys, STATE_WITHIN).await? {
            None => "no answer".to_owned(),
            Some(message) if message.term != leader.term() => "another one answered".to_owned(),
            Some(message) => match identity(&self.structure).open(&message.checkpoint) {
                Err(why) => why.to_string(),
                Ok(state) => {
                    let mut core = Identification::new(&self.structure, self.id.as_str())?;
                    match core.restore(state) {
                        Err(why) => why.to_string(),
                        Ok(()) => {
                            info!(structure = self.keys.structure().as_str(), %leader, frame = core.done(), "stands by");
                            self.failed_joins = 0;
                            return self.stand_by(core, Some(leader.clone())).await;
                        }
                    }
                }
            },
        };
        // out of step: what has been identified here so far is not what that one does
        self.leave();
        self.failed_joins += 1;
        // one that has just taken over may not answer yet
        if self.failed_joins > 1 && self.failed_joins.is_power_of_two() {
            let (structure, times) = (self.keys.structure().as_str(), self.failed_joins);
            warn!(structure, %leader, why = failed, times, "cannot stand by: no state of the one that leads");
        }
        Ok(())
    }

    /// Identifies no more until it has joined anew.
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
        let (epoch, first) = core.position().unwrap_or((0, 0)); // without a past: the epoch of the first frames
        let stream = NumberedStream {
            key: self.keys.estimates(),
            buffer_key: self.keys.estimates_buffer(),
            source: self.id.to_string(),
            epoch,
            first,
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

    /// Leads, if frames can be had: whoever sees neither a leader nor ingest has lost its link, and would only take the lead from one
    /// that is in its place.
    async fn take_over(&mut self) -> Result<(), IdentifyError> {
        if self.ingest.present().is_empty() {
            return Ok(());
        }
        // with a link all tokens go, one after the other, and what was heard of them may be behind what they are
        let ingest = self.keys.all_live(Service::Ingest);
        let (ingest, leader) = tokio::join!(
            self.bus.ask_who_is_there(&ingest, WHO_LEADS_WITHIN),
            self.bus.ask_who_leads(&self.keys, WHO_LEADS_WITHIN)
        );
        let leader = leader?;
        self.hear(leader.as_ref());
        if ingest?.is_empty() || leader.is_some() {
            return Ok(()); // its claim comes, or goes
        }
        self.lead("nobody else leads").await
    }

    /// Claims the lead, and leads unless another one claims more at the same time.
    pub(super) async fn lead(&mut self, why: &str) -> Result<(), IdentifyError> {
        if !matches!(self.seat, Seat::StandingBy(_)) {
            return Ok(());
        }
        let (remembered, former) = (
            self.memory.as_ref().map_or(0, Memory::last_term),
            self.heard,
        );
        let term = next_term(now_ns(), self.heard, remembered);
        if let Some(memory) = &self.memory {
            memory.keep_term(term);
        }
        let claim = Claim::new(term, self.bus.instance()?);
        let token = self.bus.claim(&self.keys, &claim).await?;
        let highest = self.bus.ask_who_leads(&self.keys, WHO_LEADS_WITHIN).await?;
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
            return Ok(()); // it was
        };
        let estimates = estimates.lead(&self.bus, term).await?;
        let led = self.led.latest();
        let position = self.core.as_ref().and_then(Identification::position);
        if let Some((epoch, _)) = position {
            let done = led
                .as_ref()
                .filter(|led| led.header.epoch == epoch)
                .map_or(0, |led| led.done);
            estimates.put_again(epoch, done).await?;
        }
        if let Some((epoch, done)) = position {
            // Sources may wait for what was done last before somebody died, and could not say.
            progress.set(epoch, done, self.last_time_ns.unwrap_or(i64::MIN));
        }
        if let Some(led) = &led {
            held.done(led);
        }
        for output in held.take() {
            self.displays.put(&output).await?;
        }
        self.awake = Instant::now();
        let what = format!("identification is led by {claim} from now on");
        info!(structure = self.keys.structure().as_str(), %claim, why, frame = position.map(|(_, done)| done), "leads");
        self.seat = Seat::Leading(Leading {
            claim,
            token,
            estimates,
            progress,
            questions,
            _description: description,
        });
        if in_step_with.is_some() {
            let why = format!("the one that led in term {former} is gone");
            self.tell(EventKind::Takeover, what, why).await?;
        }
        Ok(())
    }

    /// Another one leads: what this one would put now is refused by its readers.
    async fn step_back(&mut self, leader: Claim) -> Result<(), IdentifyError> {
        warn!(structure = self.keys.structure().as_str(), %leader, "superseded: another one leads, this one puts nothing more");
        self.hear(Some(&leader));
        self.leave();
        self.join(&leader).await
    }

    /// Whether it still leads, of one that did: asked of the network after a time in which it was not awake. True of all others.
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
        let highest = self.bus.ask_who_leads(&self.keys, WHO_LEADS_WITHIN).await?;
        self.awake = Instant::now();
        match highest.filter(|other| *other > own) {
            Some(leader) => self.step_back(leader).await.map(|()| false),
            None => Ok(true),
        }
    }

    /// Gives the state to one that wants to stand by.
    pub(super) fn answer(&self, question: Question) {
        let (Seat::Leading(leading), Some(core)) = (&self.seat, &self.core) else {
            return;
        };
        let (epoch, sequence) = core.position().unwrap_or((0, 0));
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
        // Megabytes over a slow link: not on a thread of the runtime, and nobody waits for it.
        spawn_blocking(move || {
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
                warn!(%error, "state not given to one that would stand by");
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_state_that_fits_no_message_is_told_with_its_size() {
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
