//! A seeded world that plays autopilot, cameras and spectrometer through the real edges, and scores
//! the answer.
//!
//! It has its own projection and Earth maths on purpose: `frames` and this crate check each other.
//! All of its truth is in one east-north-up plane at the mission datum, metres.

pub mod dataset;
pub mod render;
pub mod state;
pub mod world;
