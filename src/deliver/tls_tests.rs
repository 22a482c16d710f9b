//! The aircraft's HTTP at the real ground station's door: TLS, token, client certificate.

use super::http::{HttpError, HttpLink};
use super::tests_support::{alarm, letter};
use super::{CredentialFiles, Credentials, DatagramDelivery, Outbox, Owner};
use crate::ground::{Ground, GroundConfig, Overrides};
use crate::mission::GroundLinks;
use crate::service::courier::{IpCourier, Surroundings};
use crate::service::{Board, service_clock};
use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, IsCa, KeyPair};
use sha2::{Digest as _, Sha256};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

const TOKEN: &str = "2f6e0d5b-a-token-of-an-aircraft";

/// A station behind TLS in this process, and the files of those who come to its door.
struct Door {
    folder: tempfile::TempDir,
    ground: Ground,
    runtime: tokio::runtime::Runtime,
}

fn hex(bytes: impl AsRef<[u8]>) -> String {
    bytes.as_ref().iter().map(|b| format!("{b:02x}")).collect()
}

/// Authorities `ours` and `strange`; of ours a server's and a client's certificate. Digest of the client's.
fn write_papers(folder: &Path) -> String {
    let write = |name: &str, text: String| std::fs::write(folder.join(name), text).unwrap();
    let authority = |name: &str| {
        let mut params = CertificateParams::new(vec![name.to_owned()]).unwrap();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let issuer = CertifiedIssuer::self_signed(params, KeyPair::generate().unwrap()).unwrap();
        write(&format!("{name}.pem"), issuer.pem());
        issuer
    };
    let (ours, _strange) = (authority("ours"), authority("strange"));
    let mut digest = String::new();
    for name in ["server", "client"] {
        let key = KeyPair::generate().unwrap();
        let params = CertificateParams::new(vec!["localhost".to_owned()]).unwrap();
        let certificate = params.signed_by(&key, &ours).unwrap();
        write(&format!("{name}.crt"), certificate.pem());
        write(&format!("{name}.key"), key.serialize_pem());
        digest = hex(Sha256::digest(certificate.der()));
    }
    write("good.token", format!("{TOKEN}\n"));
    write("wrong.token", "another\n".to_owned());
    digest
}

impl Door {
    fn open() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let client = write_papers(folder.path());
        let token = hex(Sha256::digest(TOKEN));
        let text = format!(
            "data_dir = \"data\"\n[tls]\ncertificate = \"server.crt\"\nkey = \"server.key\"\n\
             client_ca = \"ours.pem\"\n\
             [[access]]\nname = \"uav-1\"\nrole = \"aircraft\"\ntoken_sha256 = \"{token}\"\n\
             [[access]]\nname = \"by paper\"\nrole = \"aircraft\"\nuavs = [\"uav-1\"]\n\
             certificate_sha256 = \"{client}\"\n"
        );
        let overrides = Overrides {
            listen: "127.0.0.1:0".parse().ok(),
            ..Overrides::default()
        };
        let path = folder.path().join("ground.toml");
        let config = GroundConfig::parse(&text, &path, overrides).unwrap();
        let runtime = tokio::runtime::Runtime::new().unwrap();
        let ground = runtime.block_on(Ground::start(config)).unwrap();
        Self {
            folder,
            ground,
            runtime,
        }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn url(&self, scheme: &str, host: &str) -> String {
        format!("{scheme}://{host}:{}", self.ground.address().port())
    }

    fn credentials(&self, ca: &str, token: Option<&str>, client: bool) -> Credentials {
        let client = client.then(|| (self.path("client.crt"), self.path("client.key")));
        Credentials::load(&CredentialFiles {
            ca: Some(self.path(ca)),
            token_file: token.map(|name| self.path(name)),
            client,
        })
        .unwrap()
    }

    fn link(&self, ca: &str, token: Option<&str>) -> HttpLink {
        let url = self.url("https", "localhost");
        HttpLink::with(&url, &self.credentials(ca, token, false)).unwrap()
    }

    fn close(self) {
        self.runtime.block_on(self.ground.stop()).unwrap();
    }
}

fn one_line(error: &HttpError, words: &[&str]) {
    let line = error.in_one_line();
    assert!(!line.contains('\n'), "{line}");
    for word in words {
        assert!(line.contains(word), "{word:?} is not in {line}");
    }
}

#[test]
fn an_alarm_arrives_over_tls_with_a_token_and_with_a_certificate() {
    let door = Door::open();
    let by_token = door.link("ours.pem", Some("good.token"));
    assert_eq!(by_token.send_letter(&letter(1, 1)).unwrap().0.revision, 1);
    assert!(by_token.health().is_ok());
    let papers = door.credentials("ours.pem", None, true);
    let by_paper = HttpLink::with(&door.url("https", "localhost"), &papers).unwrap();
    assert_eq!(by_paper.send_letter(&letter(2, 1)).unwrap().0.id, "uav-1-2");
    door.close();
}

#[test]
fn a_wrong_authority_name_token_or_scheme_is_told_in_one_line_with_what_to_do() {
    let door = Door::open();
    let strange = door
        .link("strange.pem", Some("good.token"))
        .health()
        .unwrap_err();
    assert!(matches!(strange, HttpError::Tls { .. }), "{strange:?}");
    one_line(
        &strange,
        &[
            "no authority in ground.ca signed its certificate",
            "set ground.ca",
        ],
    );

    let good = door.credentials("ours.pem", Some("good.token"), false);
    let named = HttpLink::with(&door.url("https", "127.0.0.1"), &good).unwrap();
    let unnamed = named.health().unwrap_err();
    assert!(matches!(unnamed, HttpError::Tls { .. }), "{unnamed:?}");
    one_line(
        &unnamed,
        &["not valid for name", "a name in its certificate"],
    );

    for token in [Some("wrong.token"), None] {
        let link = door.link("ours.pem", token);
        let denied = link.send_letter(&letter(1, 1)).unwrap_err();
        assert!(
            matches!(denied, HttpError::Denied { status: 401, .. }),
            "{denied:?}"
        );
        one_line(
            &denied,
            &["show a token", "ground.token_file", "token_sha256"],
        );
        let told = link.tell(&letter(1, 1)).settled;
        assert!(
            matches!(&told, super::Settled::Unreachable { reason } if reason.contains("token_sha256")),
            "{told:?}"
        );
    }
    let plain = HttpLink::new(&door.url("http", "127.0.0.1")).unwrap();
    assert!(matches!(plain.health(), Err(HttpError::Unreachable { .. })));
    door.close();
}

#[test]
fn what_would_tell_the_token_to_everyone_or_believe_anybody_is_no_link() {
    let folder = tempfile::tempdir().unwrap();
    write_papers(folder.path());
    let load = |ca: Option<&str>, token: Option<&str>, client: Option<(&str, &str)>| {
        let path = |name: &str| folder.path().join(name);
        Credentials::load(&CredentialFiles {
            ca: ca.map(path),
            token_file: token.map(path),
            client: client.map(|(certificate, key)| (path(certificate), path(key))),
        })
    };
    let token = load(None, Some("good.token"), None).unwrap();
    assert!(!format!("{token:?}").contains(TOKEN));
    let open = HttpLink::with("http://10.8.0.1:8470", &token).unwrap_err();
    assert!(matches!(open, HttpError::InTheClear { .. }));
    assert!(HttpLink::with("http://[::1]:8470", &token).is_ok());
    let unvouched = HttpLink::new("https://10.8.0.1:8470").unwrap_err();
    one_line(&unvouched, &["set ground.ca"]);
    let place = |url| {
        HttpLink::with(url, &load(Some("ours.pem"), None, None).unwrap())
            .unwrap()
            .place()
    };
    assert_eq!(place("https://a"), "a:443");
    assert_eq!(place("https://[::1]:8470/"), "[::1]:8470");

    std::fs::write(folder.path().join("two.token"), "a token").unwrap();
    std::fs::write(folder.path().join("no.pem"), "no certificate").unwrap();
    for (ca, token, client, key) in [
        (None, Some("two.token"), None, "ground.token_file"),
        (None, Some("none.token"), None, "ground.token_file"),
        (Some("no.pem"), None, None, "ground.ca"),
        (None, None, Some(("client.crt", "client.key")), "ground.ca"),
        (
            Some("ours.pem"),
            None,
            Some(("client.crt", "server.key")),
            "do not go together",
        ),
        (
            Some("ours.pem"),
            None,
            Some(("client.crt", "none.key")),
            "ground.key",
        ),
    ] {
        let problems = load(ca, token, client).unwrap_err();
        assert_eq!(problems.len(), 1, "{problems:?}");
        assert!(problems[0].contains(key), "{problems:?}");
    }
}

/// The service's own courier, to a station that nobody reaches without TLS and token: the alarm, and then
/// the fire's picture.
#[test]
fn the_courier_brings_alarm_and_picture_through_the_door() {
    let door = Door::open();
    let owner = Owner {
        uav: "uav-1".to_owned(),
        key: None,
    };
    let path = door.path("outbox.sqlite");
    let mut outbox = Outbox::open(&path, &[DatagramDelivery::NAME], owner).unwrap();
    let clock = service_clock();
    outbox.put(&alarm(1, 1), clock()).unwrap();
    let picture = [&[0xff, 0xd8, 0xff][..], &[7; 600]].concat();
    outbox.put_chip("uav-1-1", 1, &picture).unwrap();
    let links = GroundLinks {
        url: Some(door.url("https", "localhost")),
        credentials: door.credentials("ours.pem", Some("good.token"), false),
        datagrams: false,
        public_key: None,
        agent: (254, 191),
    };
    let courier = IpCourier::new(&links, outbox.origin(), None, 1)
        .unwrap()
        .unwrap();
    let (board, outbox) = (Arc::new(Board::default()), Arc::new(Mutex::new(outbox)));
    let around = Surroundings {
        outbox: Arc::clone(&outbox),
        board: Arc::clone(&board),
        clock,
        events: None,
    };
    let thread = courier.start(around).unwrap();
    let begun = Instant::now();
    let left = || {
        let outbox = outbox.lock().unwrap();
        let waiting = outbox.waiting(DatagramDelivery::NAME).unwrap();
        (waiting, outbox.chips_after(0).unwrap().len())
    };
    while left() != (0, 0) && begun.elapsed() < Duration::from_secs(30) {
        std::thread::sleep(Duration::from_millis(20));
    }
    assert_eq!(left(), (0, 0));
    board.stop();
    thread.join().unwrap();
    let kept = std::fs::read_dir(door.path("data/chips")).unwrap();
    let kept: Vec<_> = kept
        .map(|entry| std::fs::read(entry.unwrap().path()).unwrap())
        .collect();
    assert_eq!(kept, [picture]);
    door.close();
}
