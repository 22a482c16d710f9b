//! The durable outbox and one file per link.

pub mod http;
