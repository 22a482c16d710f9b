//! What the aircraft shows at the ground's door, and whose certificates it believes: files that the
//! operator puts beside the mission.
//!
//! **In:** PEM files of the authority that signed the ground's certificate and, if the ground asks for
//! one, of our own certificate and its key; a file with the token. **Out:** [`Credentials`], checked:
//! what is wrong is said before take-off, in words, with the mission's key. Nothing here is ever printed.
//! **Assumption:** no authority is believed but those in the file; those of the system are not asked.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use tokio_rustls::rustls::crypto::ring::default_provider;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::rustls::{ClientConfig, RootCertStore};
use ureq::http::HeaderValue;
use ureq::tls::{Certificate, ClientCert, PrivateKey, RootCerts, TlsConfig, TlsProvider};

/// Longest token, bytes; also what a header of the ground has room for.
const MAX_TOKEN: usize = 512;

/// Where the files lie.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct CredentialFiles {
    /// PEM: the authorities that may have signed the ground's certificate.
    pub ca: Option<PathBuf>,
    /// A line of text: what stands behind `Authorization: Bearer`.
    pub token_file: Option<PathBuf>,
    /// PEM: our own certificate, with its chain, and its private key.
    pub client: Option<(PathBuf, PathBuf)>,
}

/// Checked, and ready to use. Cheap to clone; says nothing of its secrets.
#[derive(Clone, Default)]
pub struct Credentials {
    tls: Option<TlsConfig>,
    token: Option<HeaderValue>,
}

impl std::fmt::Debug for Credentials {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        out.debug_struct("Credentials")
            .field("authority", &self.tls.is_some())
            .field("token", &self.token.is_some())
            .finish()
    }
}

impl Credentials {
    /// Reads and checks the files.
    ///
    /// # Errors
    /// Every problem, each with the mission's key and the file.
    pub fn load(files: &CredentialFiles) -> Result<Self, Vec<String>> {
        let mut problems = Vec::new();
        let mut note = |problem: String| problems.push(problem);
        let token = files.token_file.as_deref().map(read_token).transpose();
        let token = token.map_err(&mut note).ok().flatten();
        let tls = read_tls(files).map_err(note).ok().flatten();
        if problems.is_empty() {
            Ok(Self { tls, token })
        } else {
            Err(problems)
        }
    }

    /// How to speak TLS; none without an authority to believe.
    #[must_use]
    pub(super) fn tls(&self) -> Option<&TlsConfig> {
        self.tls.as_ref()
    }

    /// The header that says who we are.
    #[must_use]
    pub(super) fn authorization(&self) -> Option<&HeaderValue> {
        self.token.as_ref()
    }
}

fn read_token(path: &Path) -> Result<HeaderValue, String> {
    let said = |what: &str| format!("ground.token_file {}: {what}", path.display());
    let text = std::fs::read_to_string(path).map_err(|error| said(&error.to_string()))?;
    let token = text.trim();
    let is_fit =
        (1..=MAX_TOKEN).contains(&token.len()) && token.bytes().all(|byte| byte.is_ascii_graphic());
    let unfit = || said("allowed is one line of 1 to 512 visible characters: openssl rand -hex 32");
    if !is_fit {
        return Err(unfit());
    }
    let mut header = HeaderValue::from_str(&format!("Bearer {token}")).map_err(|_| unfit())?;
    header.set_sensitive(true);
    Ok(header)
}

fn read_tls(files: &CredentialFiles) -> Result<Option<TlsConfig>, String> {
    let Some(ca) = &files.ca else {
        return match files.client {
            None => Ok(None),
            Some(_) => {
                Err("ground.certificate without ground.ca: whom would it be shown to?".into())
            }
        };
    };
    let (authorities, roots) = read_authorities(ca)?;
    let client = files.client.as_ref();
    let client = client.map(|(certificate, key)| read_client(certificate, key, roots));
    let config = TlsConfig::builder()
        .provider(TlsProvider::Rustls)
        .unversioned_rustls_crypto_provider(Arc::new(default_provider()))
        .root_certs(RootCerts::new_with_certs(&authorities))
        .client_cert(client.transpose()?)
        .build();
    Ok(Some(config))
}

/// The authorities as both libraries want them.
fn read_authorities(path: &Path) -> Result<(Vec<Certificate<'static>>, RootCertStore), String> {
    let mut roots = RootCertStore::empty();
    let mut authorities = Vec::new();
    for der in read_certificates("ground.ca", path)? {
        authorities.push(Certificate::from_der(der.as_ref()).to_owned());
        roots
            .add(der)
            .map_err(|error| format!("ground.ca {}: {error}", path.display()))?;
    }
    Ok((authorities, roots))
}

fn read_certificates(key: &str, path: &Path) -> Result<Vec<CertificateDer<'static>>, String> {
    let said = |what: &dyn std::fmt::Display| format!("{key} {}: {what}", path.display());
    let found = CertificateDer::pem_file_iter(path).map_err(|error| said(&error))?;
    let found: Vec<_> = found
        .collect::<Result<_, _>>()
        .map_err(|error| said(&error))?;
    if found.is_empty() {
        return Err(said(&"no certificate in it, allowed is PEM"));
    }
    Ok(found)
}

/// Certificate and key that belong together: the HTTP library would not come back from a pair that do not.
fn read_client(certificate: &Path, key: &Path, roots: RootCertStore) -> Result<ClientCert, String> {
    let chain = read_certificates("ground.certificate", certificate)?;
    let key_said = |what: &dyn std::fmt::Display| format!("ground.key {}: {what}", key.display());
    let der = PrivateKeyDer::from_pem_file(key).map_err(|error| key_said(&error))?;
    ClientConfig::builder_with_provider(Arc::new(default_provider()))
        .with_safe_default_protocol_versions()
        .map_err(|error| key_said(&error))?
        .with_root_certificates(roots)
        .with_client_auth_cert(chain.clone(), der)
        .map_err(|error| {
            format!("ground.certificate and ground.key do not go together: {error}")
        })?;
    let pem = std::fs::read(key).map_err(|error| key_said(&error))?;
    let key = PrivateKey::from_pem(&pem).map_err(|error| key_said(&error))?;
    let chain: Vec<_> = chain
        .iter()
        .map(|der| Certificate::from_der(der.as_ref()).to_owned())
        .collect();
    Ok(ClientCert::new_with_certs(&chain, key))
}
