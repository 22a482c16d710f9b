//! An attacker's list: each is refused, counted and harmless. The core goes on: alarms are taken while
//! it lasts, and everything stands as before when it is over. [`super::faults`] holds the whole list.

use super::store::tests::feature;
use super::{Ground, GroundConfig, Overrides, lock};
use crate::deliver::datagram::wire::{Beat, ToGround};
use crate::deliver::envelope::Origin;
use crate::deliver::http::WIRE_KIND;
use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, IsCa, KeyPair};
use sha2::{Digest, Sha256};
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;
use tokio_rustls::rustls::crypto::ring::default_provider;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use tokio_rustls::rustls::version::{TLS12, TLS13};
use tokio_rustls::rustls::{ClientConfig, RootCertStore};

/// Longest that anything here may take before the test fails.
const PATIENCE: Duration = Duration::from_secs(20);
/// Limits that a test need not wait for.
const NARROW: &str = "[limits]\nconnections = 24\nhead_s = 0.6\nstill_s = 1.0\n";

async fn start(folder: &Path, more: &str) -> Ground {
    let overrides = Overrides {
        listen: "127.0.0.1:0".parse().ok(),
        ..Overrides::default()
    };
    let text = format!("data_dir = \"data\"\n{more}");
    let config = GroundConfig::parse(&text, &folder.join("test.toml"), overrides).unwrap();
    Ground::start(config).await.unwrap()
}

/// Sends bytes as they are; status (0 when the connection just ends) and the whole answer.
pub(super) async fn say(address: SocketAddr, bytes: &[u8]) -> (u16, String) {
    let stream = TcpStream::connect(address).await.unwrap();
    say_on(stream, bytes).await
}

async fn say_on(mut stream: impl AsyncRead + AsyncWrite + Unpin, bytes: &[u8]) -> (u16, String) {
    // Who is refused early may be hung up on before all is said.
    let _ = stream.write_all(bytes).await;
    let mut answer = Vec::new();
    let _ = tokio::time::timeout(PATIENCE, stream.read_to_end(&mut answer))
        .await
        .expect("it hangs");
    let answer = String::from_utf8_lossy(&answer).into_owned();
    let status = answer.get(9..12).and_then(|digits| digits.parse().ok());
    (status.unwrap_or_default(), answer)
}

pub(super) fn request(method: &str, path: &str, headers: &str, body: &str) -> String {
    format!(
        "{method} {path} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n{headers}\
         content-length: {}\r\n\r\n{body}",
        body.len()
    )
}

async fn post(address: SocketAddr, headers: &str, body: &str) -> (u16, String) {
    let headers = format!("content-type: application/geo+json\r\n{headers}");
    say(
        address,
        request("POST", "/alarms", &headers, body).as_bytes(),
    )
    .await
}

async fn works(address: SocketAddr, fire: u32) {
    let alarm = feature(&format!("gaochun-{fire}"), 1, "2026-03-01T12:00:01Z");
    let begun = Instant::now();
    let (status, answer) = post(address, "", &alarm).await;
    assert_eq!(status, 201, "{answer}");
    assert!(
        begun.elapsed() < Duration::from_secs(5),
        "{:?}",
        begun.elapsed()
    );
}

async fn health(address: SocketAddr) -> serde_json::Value {
    let (status, answer) = say(address, request("GET", "/health", "", "").as_bytes()).await;
    assert_eq!(status, 200, "{answer}");
    serde_json::from_str(answer.split_once("\r\n\r\n").unwrap().1).unwrap()
}

#[tokio::test]
async fn bodies_paths_headers_and_foreign_pages_are_refused_and_counted() {
    let folder = tempfile::tempdir().unwrap();
    let ground = start(folder.path(), "").await;
    let address = ground.address();
    let post_head = "POST /alarms HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\
                     content-type: application/json\r\n";
    let gigabyte = format!("{post_head}content-length: 1000000000\r\n\r\n{{");
    let chunks = format!(
        "{post_head}transfer-encoding: chunked\r\n\r\n{}",
        "8000\r\n".to_owned() + &" ".repeat(0x8000) + "\r\n"
    );
    let endless =
        chunks.clone() + &("8000\r\n".to_owned() + &" ".repeat(0x8000) + "\r\n").repeat(4);
    let nested = request(
        "POST",
        "/alarms",
        "content-type: application/json\r\n",
        &"[".repeat(60_000),
    );
    let not_text = [post_head.as_bytes(), b"content-length: 3\r\n\r\n{\"\xff"].concat();
    let many = format!(
        "GET / HTTP/1.1\r\nhost: localhost\r\n{}\r\n",
        "a: b\r\n".repeat(200)
    );
    let long = format!(
        "GET / HTTP/1.1\r\nhost: localhost\r\na: {}\r\n\r\n",
        "b".repeat(40_000)
    );
    let bomb =
        format!("{post_head}content-encoding: gzip\r\ncontent-length: 4\r\n\r\n\x1f\x08\x08\x08");
    let foreign = |headers: &str| request("POST", "/incidents/a-1/actions", headers, "{}");
    let cases: Vec<(&str, Vec<u8>, &[u16])> = vec![
        ("1 GB body", gigabyte.into(), &[413]),
        ("endless chunks", endless.into(), &[413]),
        ("nested JSON", nested.into(), &[400]),
        ("no UTF-8", not_text, &[400]),
        ("compressed", bomb.into(), &[400]),
        ("200 headers", many.into(), &[431]),
        ("a header of 40 kB", long.into(), &[431]),
        (
            "no HTTP",
            b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n".to_vec(),
            &[0, 400],
        ),
        (
            "path tricks",
            request("GET", "/../../etc/passwd", "", "").into(),
            &[404],
        ),
        (
            "escaped path",
            request("GET", "/incidents/..%2f..%2fetc%2fpasswd/chip.jpg", "", "").into(),
            &[404],
        ),
        (
            "a path of NUL",
            request("GET", "/incidents/%00/chip.jpg", "", "").into(),
            &[404],
        ),
        (
            "another host",
            b"GET / HTTP/1.1\r\nhost: evil.example\r\nconnection: close\r\n\r\n".to_vec(),
            &[421],
        ),
        (
            "no host",
            b"GET / HTTP/1.1\r\nconnection: close\r\n\r\n".to_vec(),
            &[421, 400],
        ),
        (
            "another page",
            foreign("origin: https://evil.example\r\ncontent-type: application/json\r\n").into(),
            &[403],
        ),
        (
            "a hidden page",
            foreign("origin: null\r\ncontent-type: application/json\r\n").into(),
            &[403],
        ),
        (
            "the browser says so",
            foreign("sec-fetch-site: cross-site\r\ncontent-type: application/json\r\n").into(),
            &[403],
        ),
        (
            "a form",
            foreign("content-type: text/plain\r\n").into(),
            &[415],
        ),
        (
            "another method",
            request("DELETE", "/alarms", "", "").into(),
            &[405],
        ),
        (
            "a chip that is none",
            request(
                "POST",
                "/alarms/a-1/chips/1",
                "content-type: image/jpeg\r\n",
                "<svg>",
            )
            .into(),
            &[400],
        ),
        (
            "a search for the world twice",
            request("GET", "/incidents.geojson?bbox=-400,0,1,1", "", "").into(),
            &[400],
        ),
        (
            "an order without a hand",
            request(
                "POST",
                "/incidents/a-1/actions",
                "content-type: application/json\r\n",
                "{\"kind\":\"confirm\"}",
            )
            .into(),
            &[400],
        ),
        (
            "smuggling",
            format!("{post_head}content-length: 5\r\ntransfer-encoding: chunked\r\n\r\n0\r\n\r\n")
                .into(),
            &[400],
        ),
    ];
    for (what, bytes, allowed) in &cases {
        let begun = Instant::now();
        let (status, answer) = say(address, bytes).await;
        assert!(allowed.contains(&status), "{what}: {status} {answer}");
        assert!(
            begun.elapsed() < Duration::from_secs(5),
            "{what} took {:?}",
            begun.elapsed()
        );
    }
    works(address, 1).await;
    let health = health(address).await;
    for status in ["400", "403", "404", "405", "413", "415", "421"] {
        assert!(
            health["refused_by_status"][status].as_u64() > Some(0),
            "{status}: {health}"
        );
    }
    assert!(
        health["turned_away"]["malformed"].as_u64() > Some(0),
        "{health}"
    );
    assert_eq!(health["turned_away"]["large"], 2, "heads: {health}");
    assert_eq!(
        (&health["alarms"], &health["incidents"]),
        (&1.into(), &1.into())
    );
    ground.stop().await.unwrap();
}

#[tokio::test]
async fn who_dawdles_is_shown_out_and_a_crowd_is_told_so() {
    let folder = tempfile::tempdir().unwrap();
    let ground = start(folder.path(), NARROW).await;
    let address = ground.address();
    // A head that comes in at one byte each 100 ms.
    let mut slow = TcpStream::connect(address).await.unwrap();
    let begun = Instant::now();
    let mut sent = 0;
    while begun.elapsed() < PATIENCE {
        if slow.write_all(b"G").await.is_err() || is_closed(&slow) {
            break;
        }
        sent += 1;
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    assert!(
        (1..60).contains(&sent),
        "a slow head was heard for {sent} bytes"
    );
    works(address, 1).await;
    // A crowd: more than may be inside. Those beyond are told so, and nobody who is inside minds.
    let mut crowd = Vec::new();
    let mut told = 0;
    for _ in 0..100 {
        let mut stream = TcpStream::connect(address).await.unwrap();
        let mut answer = [0; 12];
        let heard = tokio::time::timeout(Duration::from_millis(15), stream.read(&mut answer)).await;
        told += usize::from(matches!(heard, Ok(Ok(12)) if answer.ends_with(b"503")));
        crowd.push(stream);
    }
    assert!(told >= 50, "only {told} of 100 were told that it is full");
    drop(crowd);
    tokio::time::sleep(Duration::from_millis(300)).await;
    works(address, 2).await;
    let health = health(address).await;
    assert!(
        health["turned_away"]["full"].as_u64() >= Some(50),
        "{health}"
    );
    assert!(
        health["turned_away"]["slow"].as_u64() >= Some(1),
        "{health}"
    );
    ground.stop().await.unwrap();
}

#[tokio::test]
async fn who_never_reads_his_stream_is_shown_out_and_costs_nobody_else() {
    let folder = tempfile::tempdir().unwrap();
    let ground = start(folder.path(), NARROW).await;
    let address = ground.address();
    // More than the system keeps for a connection that nobody reads.
    let padding = "x".repeat(60_000);
    for fire in 0..100 {
        let alarm = feature(&format!("gaochun-{fire}"), 1, "2026-03-01T12:00:01Z");
        let alarm = alarm.replacen("\"id\"", &format!("\"padding\":\"{padding}\",\"id\""), 1);
        assert_eq!(post(address, "", &alarm).await.0, 201);
    }
    let mut deaf = Vec::new();
    for _ in 0..4 {
        let socket = tokio::net::TcpSocket::new_v4().unwrap();
        socket.set_recv_buffer_size(4_096).unwrap();
        let mut stream = socket.connect(address).await.unwrap();
        let ask = b"GET /events HTTP/1.1\r\nhost: localhost\r\n\r\n";
        stream.write_all(ask).await.unwrap();
        deaf.push(stream);
    }
    let begun = Instant::now();
    loop {
        let health = health(address).await;
        if health["turned_away"]["slow"].as_u64() >= Some(4) && health["streams"] == 0 {
            break;
        }
        assert!(begun.elapsed() < PATIENCE, "{health}");
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    works(address, 1_000).await;
    drop(deaf);
    ground.stop().await.unwrap();
}

#[tokio::test]
async fn a_clock_that_is_a_day_off_changes_neither_what_is_kept_nor_its_order() {
    let folder = tempfile::tempdir().unwrap();
    let ground = start(folder.path(), "").await;
    let now = super::now();
    for (fire, hours) in [(1, 24), (2, -24)] {
        let captured_at = now + emberfix_frames::SignedDuration::from_hours(hours);
        let captured_at = captured_at.rfc3339();
        let first = format!("\"first_seen_at\":\"{captured_at}\"");
        let told = |revision| {
            feature(&format!("gaochun-{fire}"), revision, &captured_at)
                .replace("\"first_seen_at\":\"2026-03-01T12:00:00Z\"", &first)
        };
        for (revision, status) in [(2, 201), (1, 201), (2, 200)] {
            let (answered, text) = post(ground.address(), "", &told(revision)).await;
            assert_eq!(answered, status, "{text}");
        }
        // The greater revision stands, whatever any clock says of it.
        let incident = ground.station.incident(&format!("gaochun-{fire}"));
        let incident = incident.unwrap();
        assert_eq!(incident.alarms[0].revision, 2);
        assert_eq!(incident.captured_at.rfc3339(), captured_at);
    }
    ground.stop().await.unwrap();
}

fn is_closed(stream: &TcpStream) -> bool {
    let mut byte = [0];
    matches!(stream.try_read(&mut byte), Ok(0))
}

fn digest(of: impl AsRef<[u8]>) -> String {
    Sha256::digest(of)
        .iter()
        .map(|byte| format!("{byte:02x}"))
        .collect()
}

fn accesses() -> String {
    let access = |name: &str, role: &str| {
        let token = digest(format!("token of {name}"));
        format!("[[access]]\nname = \"{name}\"\nrole = \"{role}\"\ntoken_sha256 = \"{token}\"\n")
    };
    access("gaochun", "aircraft") + &access("wall", "screen") + &access("duty", "operator")
}

fn bearer(name: &str) -> String {
    format!("authorization: Bearer token of {name}\r\n")
}

#[tokio::test]
async fn tokens_let_each_role_do_its_own_and_guessing_is_cut_short() {
    let folder = tempfile::tempdir().unwrap();
    let ground = start(folder.path(), &accesses()).await;
    let address = ground.address();
    let mine = feature("gaochun-1", 1, "2026-03-01T12:00:01Z");
    let theirs = mine.replace("\"gaochun\"", "\"another\"");
    let get = async |path: &str, who: &str| {
        say(address, request("GET", path, &bearer(who), "").as_bytes())
            .await
            .0
    };
    assert_eq!(post(address, "", &mine).await.0, 401);
    assert_eq!(post(address, &bearer("wall"), &mine).await.0, 403);
    assert_eq!(post(address, &bearer("gaochun"), &theirs).await.0, 403);
    let of_another = mine.replace("\"gaochun-1\"", "\"another-1\"");
    assert_eq!(post(address, &bearer("gaochun"), &of_another).await.0, 403);
    assert_eq!(post(address, &bearer("gaochun"), &mine).await.0, 201);
    for (uav, status) in [("another", 403), ("gaochun", 200)] {
        assert_eq!(beat(address, uav).await, status, "over /wire as {uav}");
    }
    let seen = [("gaochun", 403), ("wall", 200), ("duty", 200)];
    for (who, status) in seen {
        assert_eq!(get("/incidents.geojson", who).await, status, "{who}");
    }
    assert_eq!(get("/actions?uav=another", "gaochun").await, 403);
    assert_eq!(get("/actions?uav=gaochun", "gaochun").await, 200);
    let order = "{\"kind\":\"acknowledge\",\"by\":\"Li\",\"id\":\"k1\"}";
    for (who, status) in [
        ("wall", 403),
        ("gaochun", 403),
        ("duty", 201),
        ("duty", 200),
    ] {
        let headers = format!("content-type: application/json\r\n{}", bearer(who));
        let order = request("POST", "/incidents/gaochun-1/actions", &headers, order);
        let (answered, text) = say(address, order.as_bytes()).await;
        assert_eq!(answered, status, "{who}: {text}");
        assert!(status >= 400 || text.contains("Li (duty)"), "{text}");
    }
    // A browser's way: any name, the token as password.
    use base64::Engine;
    let pair = base64::engine::general_purpose::STANDARD.encode("Li:token of wall");
    let basic = format!("authorization: Basic {pair}\r\n");
    assert_eq!(
        say(
            address,
            request("GET", "/alarms.geojson", &basic, "").as_bytes()
        )
        .await
        .0,
        200
    );
    for _ in 0..10 {
        assert_eq!(get("/health", "nobody").await, 401);
    }
    assert_eq!(get("/health", "nobody").await, 429);
    let refused = lock(&ground.station.refusals).clone();
    for (status, least) in [(401, 11), (403, 8), (429, 1)] {
        assert!(refused[&status] >= least, "{status}: {refused:?}");
    }
    ground.stop().await.unwrap();
}

/// A beat of an aircraft over `/wire`, with the token of gaochun; the status.
async fn beat(address: SocketAddr, uav: &str) -> u16 {
    let beat = ToGround::Beat(Beat {
        origin: Origin {
            uav: uav.to_owned(),
            outbox: 7,
        },
        newest: 0,
        waiting: 0,
        actions_known: 0,
        stamp: 1,
        ping: Vec::new(),
    });
    let body = beat.datagram(None);
    let head = format!(
        "POST /wire HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n{}\
         content-type: {WIRE_KIND}\r\ncontent-length: {}\r\n\r\n",
        bearer("gaochun"),
        body.len()
    );
    say(address, &[head.as_bytes(), &body].concat()).await.0
}

#[tokio::test]
async fn a_browser_signs_in_once_and_nobody_can_do_it_in_its_name() {
    let folder = tempfile::tempdir().unwrap();
    let ground = start(folder.path(), &accesses()).await;
    let address = ground.address();
    let kind = "content-type: application/json\r\n";
    let sign_in = async |token: &str, headers: &str| {
        let body = serde_json::json!({ "token": token }).to_string();
        let headers = format!("{kind}{headers}");
        say(
            address,
            request("POST", "/session", &headers, &body).as_bytes(),
        )
        .await
    };
    // The page itself is no secret; what it asks for is, and no window of the browser's comes up.
    let get = async |path: &str, headers: &str| {
        say(address, request("GET", path, headers, "").as_bytes()).await
    };
    for open in ["/", "/page/main.js", "/icons/fire.png"] {
        assert_eq!(get(open, "").await.0, 200, "{open}");
    }
    let (status, answer) = get("/events", "sec-fetch-mode: cors\r\n").await;
    assert_eq!(status, 401);
    assert!(!answer.contains("Basic"), "{answer}");
    assert!(get("/incidents.geojson", "").await.1.contains("Basic"));

    let foreign = "origin: https://evil.example\r\nsec-fetch-site: cross-site\r\n";
    let token = "token of duty";
    for (token, headers, status) in [
        ("token of nobody", "", 401),
        ("token of gaochun", "", 403),
        (token, foreign, 403),
        ("", "", 400),
    ] {
        let (answered, answer) = sign_in(token, headers).await;
        assert_eq!(answered, status, "{token:?} {headers:?}: {answer}");
        assert!(!answer.contains("set-cookie"), "{answer}");
    }
    let (status, answer) = sign_in(token, "").await;
    assert_eq!(status, 200, "{answer}");
    assert!(!answer.contains(token), "{answer}");
    let line = answer.lines().find_map(|l| l.strip_prefix("set-cookie: "));
    let cookie = line.unwrap().split(';').next().unwrap();
    let cookie = format!("cookie: {cookie}\r\n");
    let (status, answer) = get("/session", &cookie).await;
    assert!(status == 200 && answer.contains("\"operator\""), "{answer}");
    assert_eq!(get("/incidents.geojson", &cookie).await.0, 200);
    // Another site's page makes the browser act with its cookie, if it should send it at all.
    let order = "{\"kind\":\"acknowledge\",\"by\":\"Li\"}";
    let headers = format!("{kind}{cookie}{foreign}");
    let order = request("POST", "/incidents/gaochun-1/actions", &headers, order);
    assert_eq!(say(address, order.as_bytes()).await.0, 403);
    let end = request("DELETE", "/session", &cookie, "");
    let (_, answer) = say(address, end.as_bytes()).await;
    assert!(answer.contains("Max-Age=0"), "{answer}");
    ground.stop().await.unwrap();
}

/// An authority, a server's and a client's certificate of it, and a stranger's, as PEM files.
struct Papers {
    client: [u8; 32],
}

fn papers(folder: &Path) -> Papers {
    let authority = |name: &str| {
        let mut params = CertificateParams::new(vec![name.to_owned()]).unwrap();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        CertifiedIssuer::self_signed(params, KeyPair::generate().unwrap()).unwrap()
    };
    let (ours, strange) = (authority("ours"), authority("strange"));
    let write = |name: &str, text: String| std::fs::write(folder.join(name), text).unwrap();
    write("ca.pem", ours.pem());
    let mut client = [0; 32];
    for (name, issuer) in [
        ("server", &ours),
        ("client", &ours),
        ("expired", &ours),
        ("stranger", &strange),
    ] {
        let key = KeyPair::generate().unwrap();
        let mut params = CertificateParams::new(vec!["localhost".to_owned()]).unwrap();
        if name == "expired" {
            params.not_after = rcgen::date_time_ymd(2020, 1, 1);
        }
        let certificate = params.signed_by(&key, issuer).unwrap();
        write(&format!("{name}.pem"), certificate.pem());
        write(&format!("{name}.key"), key.serialize_pem());
        if name == "client" {
            client = Sha256::digest(certificate.der()).into();
        }
    }
    Papers { client }
}

fn connector(folder: &Path, show: Option<&str>, old: bool) -> TlsConnector {
    let mut roots = RootCertStore::empty();
    roots
        .add(CertificateDer::from_pem_file(folder.join("ca.pem")).unwrap())
        .unwrap();
    let versions = if old { [&TLS12] } else { [&TLS13] };
    let builder = ClientConfig::builder_with_provider(Arc::new(default_provider()))
        .with_protocol_versions(&versions)
        .unwrap()
        .with_root_certificates(roots);
    let config = match show {
        None => builder.with_no_client_auth(),
        Some(name) => {
            let file = |end: &str| folder.join(format!("{name}.{end}"));
            let chain = vec![CertificateDer::from_pem_file(file("pem")).unwrap()];
            let key = PrivateKeyDer::from_pem_file(file("key")).unwrap();
            builder.with_client_auth_cert(chain, key).unwrap()
        }
    };
    TlsConnector::from(Arc::new(config))
}

#[tokio::test]
async fn over_tls_certificates_count_and_old_versions_and_strangers_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let papers = papers(folder.path());
    let client: String = papers
        .client
        .iter()
        .map(|byte| format!("{byte:02x}"))
        .collect();
    let more = format!(
        "[tls]\ncertificate = \"server.pem\"\nkey = \"server.key\"\nclient_ca = \"ca.pem\"\n\
         [[access]]\nname = \"duty\"\nrole = \"operator\"\ncertificate_sha256 = \"{client}\"\n{}",
        accesses().replace("\"duty\"", "\"other\"")
    );
    let ground = start(folder.path(), &more).await;
    let address = ground.address();
    let kml = async |headers: &str| {
        let stream = TcpStream::connect(address).await.unwrap();
        let name = ServerName::try_from("localhost").unwrap();
        let connecting = connector(folder.path(), Some("client"), false).connect(name, stream);
        let ask = request("GET", "/emberfix.kml", headers, "");
        say_on(connecting.await.unwrap(), ask.as_bytes()).await.1
    };
    let links = kml("").await;
    let link = "<href>https://localhost/incidents.kml</href>";
    assert!(links.contains(link), "{links}");
    let ask = async |show: Option<&str>, old: bool, headers: &str| {
        let stream = TcpStream::connect(address).await.unwrap();
        let name = ServerName::try_from("localhost").unwrap();
        match connector(folder.path(), show, old)
            .connect(name, stream)
            .await
        {
            Ok(stream) => {
                say_on(stream, request("GET", "/health", headers, "").as_bytes())
                    .await
                    .0
            }
            Err(_) => 0,
        }
    };
    assert_eq!(ask(Some("client"), false, "").await, 200);
    assert_eq!(ask(None, false, "").await, 401);
    assert_eq!(ask(None, false, &bearer("wall")).await, 200);
    assert_eq!(ask(Some("stranger"), false, &bearer("wall")).await, 0);
    assert_eq!(ask(Some("expired"), false, &bearer("wall")).await, 0);
    assert_eq!(ask(None, true, &bearer("wall")).await, 0, "TLS 1.2");
    assert_eq!(
        say(
            address,
            request("GET", "/health", &bearer("wall"), "").as_bytes()
        )
        .await
        .0,
        0
    );
    let turned = ground
        .station
        .turned
        .tls
        .load(std::sync::atomic::Ordering::Relaxed);
    assert!(turned >= 4, "{turned}");
    ground.stop().await.unwrap();
}
