//! The mission's links: whom the aircraft talks to, and what it signs with.

use crate::deliver::http::HttpLink;
use crate::deliver::keys::PublicKey;
use crate::deliver::{CredentialFiles, Credentials};
use emberfix_calib::Checks;
use emberfix_mav::SigningKey;
use emberfix_mav::signing::USUAL_UNSIGNED;
use serde::Deserialize;
use std::path::{Path, PathBuf};

/// How alarms reach the ground.
#[derive(Debug, Clone)]
pub struct GroundLinks {
    /// HTTP or HTTPS address of the ground station, if there is an IP path.
    pub url: Option<String>,
    /// Whose certificates are believed, and what is shown at the ground's door.
    pub credentials: Credentials,
    /// Whether datagrams go to the same host and port.
    pub datagrams: bool,
    /// The ground's public key: with it, only what the ground signed is believed.
    pub public_key: Option<PublicKey>,
    /// MAVLink address (system, component) of our ground agent.
    pub agent: (u8, u8),
}

/// MAVLink 2 signing.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MavlinkSigning {
    /// The secret of the vehicle's network.
    pub key: SigningKey,
    /// Messages that are taken unsigned.
    pub unsigned_ids: Vec<u32>,
}

#[derive(Deserialize)]
#[serde(default)]
pub(super) struct RawGround {
    url: Option<String>,
    ca: Option<PathBuf>,
    token_file: Option<PathBuf>,
    certificate: Option<PathBuf>,
    key: Option<PathBuf>,
    datagrams: bool,
    public_key: Option<String>,
    agent_system_id: u8,
    agent_component_id: u8,
}

impl Default for RawGround {
    fn default() -> Self {
        Self {
            url: None,
            ca: None,
            token_file: None,
            certificate: None,
            key: None,
            datagrams: true,
            public_key: None,
            agent_system_id: 254,
            agent_component_id: 191,
        }
    }
}

impl RawGround {
    pub fn check(&self, checks: &mut Checks) {
        if let Some(Err(error)) = self.public_key() {
            checks.problem(format!("ground.public_key: {error}"));
        }
        if self.certificate.is_some() != self.key.is_some() {
            checks.problem("ground.certificate and ground.key: one without the other".to_owned());
        }
    }

    /// With the files that it names, relative ones beside the mission.
    pub fn build(self, beside: &dyn Fn(&Path) -> PathBuf) -> Result<GroundLinks, Vec<String>> {
        let path = |path: &Option<PathBuf>| path.as_deref().map(beside);
        let credentials = Credentials::load(&CredentialFiles {
            ca: path(&self.ca),
            token_file: path(&self.token_file),
            client: path(&self.certificate).zip(path(&self.key)),
        })?;
        if let Some(url) = &self.url {
            HttpLink::with(url, &credentials).map_err(|error| vec![error.in_one_line()])?;
        }
        Ok(GroundLinks {
            public_key: self.public_key().and_then(Result::ok),
            credentials,
            url: self.url,
            datagrams: self.datagrams,
            agent: (self.agent_system_id, self.agent_component_id),
        })
    }

    fn public_key(&self) -> Option<Result<PublicKey, crate::deliver::keys::KeyError>> {
        self.public_key.as_deref().map(str::parse)
    }
}

#[derive(Deserialize)]
pub(super) struct RawMavlink {
    pub url: String,
    signing_key: Option<PathBuf>,
    unsigned_ids: Option<Vec<u32>>,
}

impl RawMavlink {
    /// The signing key is a file of 64 hexadecimal digits.
    pub fn signing(
        &self,
        beside: &dyn Fn(&Path) -> PathBuf,
    ) -> Result<Option<MavlinkSigning>, String> {
        let Some(path) = self.signing_key.as_deref().map(beside) else {
            return Ok(None);
        };
        Ok(Some(MavlinkSigning {
            key: load_signing_key(&path).map_err(|e| format!("mavlink.signing_key: {e}"))?,
            unsigned_ids: self
                .unsigned_ids
                .clone()
                .unwrap_or_else(|| USUAL_UNSIGNED.to_vec()),
        }))
    }
}

/// Reads a MAVLink signing key: a file of 64 hexadecimal digits.
///
/// # Errors
/// What is wrong, in words.
pub fn load_signing_key(path: &Path) -> Result<SigningKey, String> {
    let text = std::fs::read_to_string(path).map_err(|e| format!("{}: {e}", path.display()))?;
    SigningKey::from_hex(&text).ok_or_else(|| {
        format!(
            "{} holds no key, allowed are 64 hexadecimal digits (the SHA-256 of the ground station's \
             passphrase)",
            path.display()
        )
    })
}
