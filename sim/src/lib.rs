//! A seeded world that plays autopilot, cameras and spectrometer through the real edges, and scores
//! the answer.
//!
//! It has its own projection and Earth maths on purpose: `frames` and this crate check each other.
//! All of its truth is in one east-north-up plane at the mission datum, metres.

pub mod autopilot;
pub mod earth;
pub mod flight;
pub mod mission;
pub mod noise;
pub mod render;
pub mod score;
pub mod state;
pub mod stream;
pub mod world;
