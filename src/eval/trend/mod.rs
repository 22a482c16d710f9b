//! Trend, size and spread of simulated burns.

pub mod burns;
pub mod score;
