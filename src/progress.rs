//! Progress and cancellation of long work.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Instant;

use crate::{Error, Result};

/// Milliseconds since `start`.
pub fn ms_since(start: Instant) -> f64 {
    1e3 * start.elapsed().as_secs_f64()
}

/// Shared between the thread that does the work and the one that shows it; the library itself never prints.
#[derive(Debug, Default)]
pub struct Progress {
    done: AtomicU64,
    total: AtomicU64,
    cancelled: AtomicBool,
    /// Shown as lines for a program to read, not as a bar.
    pub as_lines: bool,
}

impl Progress {
    /// Shown as lines for a program to read, or as a bar.
    pub fn new(as_lines: bool) -> Self {
        Self { as_lines, ..Self::default() }
    }

    /// Starts a new piece of work of `total` steps.
    pub fn begin(&self, total: u64) {
        self.done.store(0, Ordering::Relaxed);
        self.total.store(total, Ordering::Relaxed);
    }

    /// Reports steps done, and fails with [`Error::Cancelled`] once the user has asked to stop.
    pub fn advance(&self, steps: u64) -> Result<()> {
        self.done.fetch_add(steps, Ordering::Relaxed);
        self.check()
    }

    /// Fails with [`Error::Cancelled`] once the user has asked to stop.
    pub fn check(&self) -> Result<()> {
        if self.cancelled.load(Ordering::Relaxed) { Err(Error::Cancelled) } else { Ok(()) }
    }

    /// Asks the work to stop; it does within a fraction of a second.
    pub fn cancel(&self) {
        self.cancelled.store(true, Ordering::Relaxed);
    }

    /// Steps done and steps in all.
    pub fn state(&self) -> (u64, u64) {
        (self.done.load(Ordering::Relaxed), self.total.load(Ordering::Relaxed))
    }
}
