//! The durable outbox, and one file per link.
//!
//! **Purpose.** An alarm reaches the ground although links fail, slowly fill, and lie.
//!
//! **In.** [`crate::alarm::Alarm`]s, and telemetry of the ground agent (its `COMMAND_ACK`s).
//! **Out.** Over MAVLink, as messages for the pipeline's one connection ([`mavlink`], sans-IO):
//! STATUSTEXT and CAMERA_TRACKING_GEO_STATUS for stock ground stations, COMMAND_INT for our ground
//! agent ([`spatial`]). Over IP: whole alarms. All are [`AlarmLink`]s, held to one contract.
//!
//! **The way of one alarm.** [`Outbox::put`] (on disk) -> [`Outbox::pending`] per link, urgent first
//! -> the link -> its receipt -> [`Outbox::acknowledge`] (on disk). At least once, per link; the
//! receiver tells repetitions by id and revision.
//!
//! **Bounds and loss rules.** The outbox keeps the newest revision of every alarm until each link
//! delivered it, up to [`Outbox::MAX_WAITING`]; then new alarms are refused loudly. A link with
//! more news than room sends the newest revision only. STATUSTEXT and CAMERA_TRACKING_GEO_STATUS
//! are told, not delivered: they may be lost.
//!
//! **Ids.** An alarm's id is `<uav>-<fire number>`; an aircraft without a name is
//! `uav-<MAVLink system id>`. Fire numbers come from the outbox and never repeat on one aircraft.
//!
//! **Assumptions.** One service per outbox. Time is an argument; nothing here reads a clock.
//!
//! **Signatures.** Every alarm goes in one signed envelope, the same over each link that carries whole
//! alarms ([`envelope`], [`keys`]); what MAVLink carries is a summary, guarded by MAVLink's own signing.
//!
//! **Ways over IP**, one link in the outbox: datagrams ([`datagram`]), and HTTP ([`lanes`]) for what fits
//! into none, or where no datagram gets through.

pub mod credentials;
pub mod datagram;
pub mod envelope;
pub mod http;
pub mod keys;
pub mod lanes;
pub mod link;
pub mod mavlink;
pub mod orders;
pub mod outbox;
pub mod signing_file;
pub mod spatial;

#[cfg(test)]
mod contract;

pub use credentials::{CredentialFiles, Credentials};
pub use datagram::{DatagramDelivery, DatagramSettings};
pub use http::{HttpError, HttpLink};
pub use lanes::HttpLanes;
pub use link::{AlarmLink, Courier, Letter, Receipt, Settled, Urgency};
pub use mavlink::{MavlinkDelivery, MavlinkSettings};
pub use outbox::{Outbox, OutboxError, Owner, Put};

use crate::alarm::FireId;
use emberfix_mav::SystemId;

/// Id of an alarm.
#[must_use]
pub fn alarm_id(uav: &str, fire: FireId) -> String {
    format!("{uav}-{}", fire.0)
}

/// The fire that an alarm id names.
#[must_use]
pub fn fire_number(alarm_id: &str) -> Option<FireId> {
    let (_, number) = alarm_id.rsplit_once('-')?;
    number.parse().ok().map(FireId)
}

/// Name of an aircraft that was given none.
#[must_use]
pub fn default_uav(system: SystemId) -> String {
    format!("uav-{}", system.0)
}

#[cfg(test)]
mod tests_support;
#[cfg(test)]
mod tls_tests;
