//! Ed25519 keys: the aircraft signs its alarms, the ground its receipts.
//!
//! A secret key is a file of one line, `emberfix-secret-1:BASE64`, readable by its owner only. A
//! public key is text, `ed25519:BASE64`, to be copied into the other side's configuration.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use ed25519_dalek::{Signer as _, SigningKey};
use rand::RngCore as _;
use std::io::Write as _;
use std::os::unix::fs::{OpenOptionsExt as _, PermissionsExt as _};
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// Bytes of a signature.
pub const SIGNATURE_LEN: usize = 64;
/// An Ed25519 signature.
pub type Signature = [u8; SIGNATURE_LEN];

const SECRET_PREFIX: &str = "emberfix-secret-1:";
const PUBLIC_PREFIX: &str = "ed25519:";

/// Why a key can't be had.
#[derive(Debug, thiserror::Error)]
pub enum KeyError {
    /// The file can't be read or made.
    #[error("key {}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file holds no secret key.
    #[error("key {}: not a line {SECRET_PREFIX}BASE64 of 32 bytes", path.display())]
    Secret {
        /// The file.
        path: PathBuf,
    },
    /// Others may read the file.
    #[error("key {}: mode {mode:03o} lets others read it, allowed is 600: chmod 600 it, or make another", path.display())]
    Open {
        /// The file.
        path: PathBuf,
        /// Its permissions.
        mode: u32,
    },
    /// The text is no public key.
    #[error(
        "public key {text:?} is not {PUBLIC_PREFIX}BASE64 of 32 bytes that are a point of the curve"
    )]
    Public {
        /// What was given.
        text: String,
    },
}

/// A secret key, to sign with.
#[derive(Clone)]
pub struct SecretKey(SigningKey);

impl SecretKey {
    /// A new one.
    #[must_use]
    pub fn random() -> Self {
        let mut seed = [0; 32];
        rand::rng().fill_bytes(&mut seed);
        Self::from_seed(seed)
    }

    /// From its 32 bytes.
    #[must_use]
    pub fn from_seed(seed: [u8; 32]) -> Self {
        Self(SigningKey::from_bytes(&seed))
    }

    /// Reads a key file; makes one, readable by its owner only, where there is none.
    ///
    /// # Errors
    /// [`KeyError`].
    pub fn load_or_make(path: &Path) -> Result<Self, KeyError> {
        match Self::load(path) {
            Err(KeyError::Io { source, .. }) if source.kind() == std::io::ErrorKind::NotFound => {
                Self::random().save_new(path)
            }
            loaded => loaded,
        }
    }

    /// Reads a key file.
    ///
    /// # Errors
    /// [`KeyError`]; a file that others may read is refused.
    pub fn load(path: &Path) -> Result<Self, KeyError> {
        let failed = |source| KeyError::Io {
            path: path.to_owned(),
            source,
        };
        let mode = std::fs::metadata(path)
            .map_err(failed)?
            .permissions()
            .mode()
            & 0o777;
        if mode & 0o077 != 0 {
            return Err(KeyError::Open {
                path: path.to_owned(),
                mode,
            });
        }
        let text = std::fs::read_to_string(path).map_err(failed)?;
        let seed = text.trim().strip_prefix(SECRET_PREFIX).and_then(bytes);
        seed.map(Self::from_seed).ok_or_else(|| KeyError::Secret {
            path: path.to_owned(),
        })
    }

    /// Written beside its place, synced, then moved there: a kill leaves a whole key or none.
    fn save_new(self, path: &Path) -> Result<Self, KeyError> {
        let write = || {
            let beside = path.with_added_extension("new");
            let mut options = std::fs::OpenOptions::new();
            options.write(true).create(true).truncate(true).mode(0o600);
            let mut file = options.open(&beside)?;
            file.write_all(
                format!("{SECRET_PREFIX}{}\n", BASE64.encode(self.0.to_bytes())).as_bytes(),
            )?;
            file.sync_all()?;
            std::fs::rename(&beside, path)?;
            let folder = path
                .parent()
                .filter(|folder| !folder.as_os_str().is_empty());
            std::fs::File::open(folder.unwrap_or(Path::new(".")))?.sync_all()
        };
        write().map_err(|source| KeyError::Io {
            path: path.to_owned(),
            source,
        })?;
        Ok(self)
    }

    /// What others need to check our signatures.
    #[must_use]
    pub fn public(&self) -> PublicKey {
        PublicKey(self.0.verifying_key())
    }

    /// Signs.
    #[must_use]
    pub fn sign(&self, bytes: &[u8]) -> Signature {
        self.0.sign(bytes).to_bytes()
    }
}

/// Never shows the secret.
impl std::fmt::Debug for SecretKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "SecretKey(of {})", self.public())
    }
}

/// A public key, to check signatures with.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct PublicKey(ed25519_dalek::VerifyingKey);

impl PublicKey {
    /// Whether `signature` is one of these bytes under this key (strict: no malleable ones).
    #[must_use]
    pub fn verifies(&self, bytes: &[u8], signature: &Signature) -> bool {
        let signature = ed25519_dalek::Signature::from_bytes(signature);
        self.0.verify_strict(bytes, &signature).is_ok()
    }
}

impl FromStr for PublicKey {
    type Err = KeyError;

    fn from_str(text: &str) -> Result<Self, KeyError> {
        let given = text.trim().strip_prefix(PUBLIC_PREFIX).and_then(bytes);
        given
            .and_then(|bytes| ed25519_dalek::VerifyingKey::from_bytes(&bytes).ok())
            .filter(|key| !key.is_weak())
            .map(Self)
            .ok_or_else(|| KeyError::Public {
                text: text.to_owned(),
            })
    }
}

impl std::fmt::Display for PublicKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{PUBLIC_PREFIX}{}", BASE64.encode(self.0.as_bytes()))
    }
}

impl std::fmt::Debug for PublicKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "PublicKey({self})")
    }
}

fn bytes(base64: &str) -> Option<[u8; 32]> {
    BASE64.decode(base64).ok()?.try_into().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_is_made_once_and_only_its_owner_reads_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("uav.key");
        let made = SecretKey::load_or_make(&path).unwrap();
        let again = SecretKey::load_or_make(&path).unwrap();
        assert_eq!(made.public(), again.public());
        let mode = std::fs::metadata(&path).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
        assert!(!format!("{made:?}").contains(&BASE64.encode(made.0.to_bytes())));
    }

    #[test]
    fn a_file_that_others_read_or_that_holds_no_key_is_refused_and_left_alone() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("uav.key");
        std::fs::write(&path, "emberfix-secret-1:AAAA\n").unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o644)).unwrap();
        assert!(matches!(
            SecretKey::load_or_make(&path),
            Err(KeyError::Open { mode: 0o644, .. })
        ));
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600)).unwrap();
        assert!(matches!(
            SecretKey::load_or_make(&path),
            Err(KeyError::Secret { .. })
        ));
        assert_eq!(
            std::fs::read_to_string(&path).unwrap(),
            "emberfix-secret-1:AAAA\n"
        );
    }

    /// RFC 8032, section 7.1, test 2.
    #[test]
    fn signatures_are_those_of_rfc_8032() {
        let seed = "4ccd089b28ff96da9db6c346ec114e0f5b8a319f35aba624da8cf6ed4fb8a6fb";
        let expected = "92a009a9f0d4cab8720e820b5f642540a2b27b5416503f8fb3762223ebdb69da\
                        085ac1e43e15996e458f3613d0f11d8c387b2eaeb4302aeeb00d291612bb0c00";
        let key = SecretKey::from_seed(hex(seed).try_into().unwrap());
        let signature = key.sign(&[0x72]);
        assert_eq!(signature.to_vec(), hex(expected));
        assert!(key.public().verifies(&[0x72], &signature));
        assert!(!key.public().verifies(&[0x73], &signature));
    }

    #[test]
    fn a_public_key_reads_back_and_a_wrong_one_is_refused() {
        let public = SecretKey::random().public();
        assert_eq!(public.to_string().parse::<PublicKey>().unwrap(), public);
        let small_order = format!("ed25519:{}", BASE64.encode([0_u8; 32]));
        for text in ["", "ed25519:AAAA", small_order.as_str(), "rsa:AAAA"] {
            assert!(text.parse::<PublicKey>().is_err(), "{text}");
        }
    }

    fn hex(text: &str) -> Vec<u8> {
        (0..text.len() / 2)
            .map(|at| u8::from_str_radix(&text[2 * at..2 * at + 2], 16).unwrap())
            .collect()
    }
}
