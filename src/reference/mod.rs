//! What everything else is judged by.

pub mod cache;
pub mod exact;
pub mod verify;
