//! The threads that filters run on.

use std::num::NonZeroUsize;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::thread;

type Job = Box<dyn FnOnce() + Send>;

/// A fixed number of threads that carry out filter work in the order in which it is handed over.
///
/// A structure hands over one block at a time and waits for it, so that its frames stay in order whatever thread takes
/// them; many structures share the threads. The queue holds at most one job per structure, so it is bounded by their number.
#[derive(Debug, Clone)]
pub struct FilterPool {
    jobs: flume::Sender<Job>,
}

impl FilterPool {
    /// Starts the threads; they end when the last clone of the pool is dropped.
    ///
    /// # Errors
    /// When the system refuses a thread.
    pub fn start(threads: NonZeroUsize) -> std::io::Result<Self> {
        let (jobs, waiting) = flume::unbounded::<Job>();
        for index in 0..threads.get() {
            let waiting = waiting.clone();
            thread::Builder::new()
                .name(format!("filter-{index}"))
                .spawn(move || {
                    while let Ok(job) = waiting.recv() {
                        // What a job was working on is dropped with it, and whoever waits for it hears so: the thread goes on for
                        // all other structures. The panic itself has been reported where it happened.
                        drop(catch_unwind(AssertUnwindSafe(job)));
                    }
                })?;
        }
        Ok(Self { jobs })
    }

    /// Returns whether a thread carries out work that is handed over now; waits as long as it takes.
    pub async fn responds(&self) -> bool {
        self.run(|| ()).await.is_some()
    }

    /// Carries out `work` on one of the threads and returns what it returns; `None` when it panicked or the pool is gone.
    pub(crate) async fn run<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Option<T> {
        let (done, result) = tokio::sync::oneshot::channel();
        let job: Job = Box::new(move || {
            // whoever waited may have been stopped
            let _ = done.send(work());
        });
        self.jobs.send(job).ok()?;
        result.await.ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_job_that_panics_takes_nothing_with_it() {
        let pool = FilterPool::start(NonZeroUsize::MIN).unwrap();
        assert_eq!(pool.run(|| 1).await, Some(1));
        assert_eq!(
            pool.run(|| if true { panic!("as it should") } else { 2 })
                .await,
            None
        );
        assert_eq!(pool.run(|| 3).await, Some(3));
    }
}
