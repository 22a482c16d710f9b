//! A seeded world that plays autopilot, cameras and spectrometer through the real edges, and scores
//! the answer.
//!
//! It has its own projection and Earth maths on purpose: `frames` and this crate check each other.
//! All of its truth is in one east-north-up plane at the mission datum, metres.

pub mod autopilot;
pub mod cameras;
pub mod dataset;
pub mod demo;
pub mod earth;
pub mod flight;
pub mod live;
pub mod mission;
pub mod noise;
pub mod record;
pub mod render;
pub mod score;
pub mod spectrometer;
pub mod state;
pub mod stream;
pub mod world;

use flight::Flight;
use mission::Mission;
use std::sync::Arc;
use world::{World, WorldError};

/// The mission's world, and its flight through it.
///
/// # Errors
/// [`WorldError`] when `[sim.world]` has a value that no world has.
pub fn setup(mission: &Mission) -> Result<(Arc<World>, Arc<Flight>), WorldError> {
    let sim = &mission.sim;
    let world = World::new(&sim.world, sim.seed)?;
    let ground_up_m = |east_m, north_m| world.ground_up_m(east_m, north_m);
    let flight = Flight::new(&sim.flight, sim.seed, ground_up_m);
    Ok((Arc::new(world), Arc::new(flight)))
}
