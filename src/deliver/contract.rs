//! What every link keeps to, as one suite: the real ones against a double of the other side, and a
//! fake that is right by construction.

use super::datagram::wire::{ToAircraft, ToGround, Verdict};
use super::datagram::{DatagramDelivery, DatagramSettings};
use super::envelope::Origin;
use super::http::HttpLink;
use super::keys::SecretKey;
use super::lanes::HttpLanes;
use super::link::{AlarmLink, Letter, Receipt, Settled};
use super::mavlink::{MavlinkDelivery, MavlinkSettings};
use super::spatial;
use super::tests_support::letter;
use emberfix_frames::{ServiceTime, SignedDuration};
use emberfix_mav::outgoing::companion_heartbeat;
use emberfix_mav::telemetry::{CommandAck, CommandResult};
use emberfix_mav::{Address, Encoder, RawFrame, Telemetry, decode};
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::sync::{Arc, Mutex};

/// The other side's disk and moods.
#[derive(Default)]
struct Other {
    held: Vec<(String, u32)>,
    cut: bool,
    refuses: Option<String>,
}

impl Other {
    fn keep(&mut self, id: &str, revision: u32) -> Verdict {
        if self.refuses.as_deref() == Some(id) {
            return Verdict::Refused("not this one".to_owned());
        }
        let known = (id.to_owned(), revision);
        if !self.held.contains(&known) {
            self.held.push(known);
        }
        Verdict::Stored
    }
}

/// A link and its other side.
trait Bench {
    /// Lets 10 ms pass.
    fn step(&mut self, waiting: &[Letter]) -> Vec<Settled>;
    fn other(&self) -> &Mutex<Other>;
}

const STEP: SignedDuration = SignedDuration::from_millis(10);

fn start() -> ServiceTime {
    letter(1, 1).alarm.properties.captured_at
}

/// Runs as the courier does: what was delivered waits no more.
fn run(bench: &mut dyn Bench, waiting: &mut Vec<Letter>, steps: u32) -> Vec<Settled> {
    let mut all = Vec::new();
    for _ in 0..steps {
        let settled = bench.step(waiting);
        for settled in &settled {
            if let Settled::Delivered(receipt) = settled {
                waiting.retain(|letter| {
                    letter.id() != receipt.id || letter.revision() > receipt.revision
                });
            }
        }
        all.extend(settled);
    }
    all
}

fn delivered(settled: &[Settled]) -> Vec<(String, u32)> {
    let receipts = settled.iter().filter_map(|settled| match settled {
        Settled::Delivered(Receipt { id, revision }) => Some((id.clone(), *revision)),
        _ => None,
    });
    receipts.collect()
}

fn keeps_to_the_contract(mut make: impl FnMut() -> Box<dyn Bench>) {
    delivers_each_once(make().as_mut());
    tells_nothing_delivered_while_cut_and_all_within_two_seconds_after(make().as_mut());
    one_refused_delays_no_other_by_a_second(make().as_mut());
    a_newer_revision_is_not_settled_by_an_older_one(make().as_mut());
    what_waits_no_more_is_sent_no_more(make().as_mut());
}

fn delivers_each_once(bench: &mut dyn Bench) {
    let mut waiting: Vec<Letter> = (1..=3).map(|number| letter(number, 1)).collect();
    let settled = run(bench, &mut waiting, 200);
    let mut there = delivered(&settled);
    there.sort();
    let expected: Vec<_> = (1..=3).map(|n| (format!("uav-1-{n}"), 1)).collect();
    assert_eq!(there, expected);
    let mut held = bench.other().lock().unwrap().held.clone();
    held.sort();
    assert_eq!(held, expected);
}

fn tells_nothing_delivered_while_cut_and_all_within_two_seconds_after(bench: &mut dyn Bench) {
    bench.other().lock().unwrap().cut = true;
    let mut waiting: Vec<Letter> = (1..=3).map(|number| letter(number, 1)).collect();
    assert_eq!(delivered(&run(bench, &mut waiting, 300)), []);
    assert_eq!(bench.other().lock().unwrap().held, []);
    bench.other().lock().unwrap().cut = false;
    assert_eq!(delivered(&run(bench, &mut waiting, 200)).len(), 3);
}

fn one_refused_delays_no_other_by_a_second(bench: &mut dyn Bench) {
    bench.other().lock().unwrap().refuses = Some("uav-1-1".to_owned());
    let mut waiting: Vec<Letter> = (1..=3).map(|number| letter(number, 1)).collect();
    let settled = run(bench, &mut waiting, 100);
    assert_eq!(delivered(&settled).len(), 2, "{settled:?}");
    assert!(
        settled
            .iter()
            .any(|s| matches!(s, Settled::Refused { id, .. } if id == "uav-1-1"))
    );
    waiting.push(letter(4, 1));
    assert_eq!(
        delivered(&run(bench, &mut waiting, 100)),
        [("uav-1-4".to_owned(), 1)]
    );
    assert_eq!(waiting.len(), 1);
}

fn a_newer_revision_is_not_settled_by_an_older_one(bench: &mut dyn Bench) {
    bench.other().lock().unwrap().cut = true;
    run(bench, &mut vec![letter(1, 1)], 30);
    bench.other().lock().unwrap().cut = false;
    let mut waiting = vec![letter(1, 2)];
    let settled = run(bench, &mut waiting, 300);
    assert_eq!(delivered(&settled).last(), Some(&("uav-1-1".to_owned(), 2)));
    assert!(waiting.is_empty());
    assert!(
        bench
            .other()
            .lock()
            .unwrap()
            .held
            .contains(&("uav-1-1".to_owned(), 2))
    );
}

fn what_waits_no_more_is_sent_no_more(bench: &mut dyn Bench) {
    bench.other().lock().unwrap().cut = true;
    run(bench, &mut vec![letter(1, 1)], 20);
    run(bench, &mut Vec::new(), 20);
    bench.other().lock().unwrap().cut = false;
    run(bench, &mut Vec::new(), 200);
    assert_eq!(bench.other().lock().unwrap().held, []);
}

/// Right by construction: what the suite says is not what one link happens to do.
struct FakeBench {
    other: Mutex<Other>,
}

impl Bench for FakeBench {
    fn step(&mut self, waiting: &[Letter]) -> Vec<Settled> {
        let mut other = self.other.lock().unwrap();
        if other.cut {
            let reason = "cut".to_owned();
            return vec![Settled::Unreachable { reason }];
        }
        let tell = |letter: &Letter| match other.keep(letter.id(), letter.revision()) {
            Verdict::Stored => Settled::Delivered(Receipt {
                id: letter.id().to_owned(),
                revision: letter.revision(),
            }),
            Verdict::Refused(reason) | Verdict::Later(reason) => Settled::Refused {
                id: letter.id().to_owned(),
                revision: letter.revision(),
                reason,
            },
        };
        waiting.iter().map(tell).collect()
    }

    fn other(&self) -> &Mutex<Other> {
        &self.other
    }
}

/// Datagrams that take one step each way; every third is lost.
struct DatagramBench {
    link: DatagramDelivery,
    other: Mutex<Other>,
    key: SecretKey,
    now: ServiceTime,
    back: Vec<Vec<u8>>,
    sent: u32,
}

impl DatagramBench {
    fn new() -> Self {
        let key = SecretKey::random();
        let settings = DatagramSettings {
            origin: Origin {
                uav: "uav-1".to_owned(),
                outbox: 7,
            },
            key: None,
            ground: Some(key.public()),
            seed: 1,
        };
        Self {
            link: DatagramDelivery::new(settings),
            other: Mutex::default(),
            key,
            now: start(),
            back: Vec::new(),
            sent: 0,
        }
    }

    fn answer(&self, datagram: &[u8]) -> Option<Vec<u8>> {
        let said = match ToGround::read(datagram).unwrap().0 {
            ToGround::Letter { attempt, sealed } => {
                let alarm = crate::alarm::Alarm::from_geojson(&sealed.envelope.alarm).unwrap();
                let (id, revision) = (&alarm.properties.id, alarm.properties.revision);
                ToAircraft::Receipt {
                    origin: sealed.envelope.origin.clone(),
                    sequence: sealed.envelope.sequence,
                    attempt,
                    verdict: self.other.lock().unwrap().keep(id, revision),
                    newest_action: 0,
                }
            }
            ToGround::Beat(beat) => ToAircraft::Answer {
                origin: beat.origin,
                stamp: beat.stamp,
                newest_action: 0,
            },
            ToGround::Ask(_) | ToGround::Chip(_) => return None,
        };
        Some(said.datagram(Some(&self.key)))
    }

    fn is_lost(&mut self) -> bool {
        self.sent += 1;
        self.sent.is_multiple_of(3) || self.other.lock().unwrap().cut
    }
}

impl Bench for DatagramBench {
    fn step(&mut self, waiting: &[Letter]) -> Vec<Settled> {
        self.now = self.now + STEP;
        for datagram in std::mem::take(&mut self.back) {
            self.link.take(&datagram, self.now);
        }
        let settled = self.link.work(waiting, self.now);
        while let Some(datagram) = self.link.poll(self.now) {
            if !self.is_lost()
                && let Some(answer) = self.answer(&datagram)
                && !self.is_lost()
            {
                self.back.push(answer);
            }
        }
        settled
    }

    fn other(&self) -> &Mutex<Other> {
        &self.other
    }
}

/// The MAVLink delivery and a ground agent.
struct MavlinkBench {
    link: MavlinkDelivery,
    other: Mutex<Other>,
    now: ServiceTime,
    steps: u32,
}

impl MavlinkBench {
    const OWN: Address = Address::new(1, 191);

    fn new() -> Self {
        Self {
            link: MavlinkDelivery::new(MavlinkSettings::new(Self::OWN)),
            other: Mutex::default(),
            now: start(),
            steps: 0,
        }
    }

    fn answer(&self, frame: &[u8]) -> Option<Telemetry> {
        let Ok(Telemetry::CommandInt(order)) = decode(&RawFrame::at_start(frame)?.0) else {
            return None;
        };
        let told = spatial::decode(&order).unwrap();
        let id = super::alarm_id("uav-1", told.fire);
        let verdict = self.other.lock().unwrap().keep(&id, told.revision);
        Some(Telemetry::CommandAck(CommandAck {
            command: order.command,
            result: match verdict {
                Verdict::Stored => CommandResult::Accepted,
                Verdict::Refused(_) | Verdict::Later(_) => CommandResult::Denied,
            },
            result_param2: spatial::receipt(told.fire, told.revision),
            target: Self::OWN,
        }))
    }
}

impl Bench for MavlinkBench {
    fn step(&mut self, waiting: &[Letter]) -> Vec<Settled> {
        self.now = self.now + STEP;
        self.steps += 1;
        let cut = self.other.lock().unwrap().cut;
        if self.steps.is_multiple_of(100) && !cut {
            let beat = Encoder::new(MavlinkSettings::GROUND).encode(&companion_heartbeat(true));
            let beat = decode(&RawFrame::at_start(&beat).unwrap().0).unwrap();
            self.link.observe(MavlinkSettings::GROUND, &beat, self.now);
        }
        let settled = self.link.work(waiting, self.now);
        while let Some(message) = self.link.poll(self.now) {
            let frame = Encoder::new(Self::OWN).encode(&message);
            if !cut && let Some(ack) = self.answer(&frame) {
                self.link.observe(MavlinkSettings::GROUND, &ack, self.now);
            }
        }
        settled
    }

    fn other(&self) -> &Mutex<Other> {
        &self.other
    }
}

/// HTTP against a server of a few lines; the time is real.
struct HttpBench {
    lanes: HttpLanes,
    other: Arc<Mutex<Other>>,
    begun: std::time::Instant,
}

impl HttpBench {
    fn new() -> Self {
        let socket = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let url = format!("http://{}", socket.local_addr().unwrap());
        let other = Arc::<Mutex<Other>>::default();
        let theirs = Arc::clone(&other);
        std::thread::spawn(move || {
            for stream in socket.incoming().flatten() {
                let other = Arc::clone(&theirs);
                std::thread::spawn(move || serve(&stream, &other));
            }
        });
        Self {
            lanes: HttpLanes::new(HttpLink::new(&url).unwrap()),
            other,
            begun: std::time::Instant::now(),
        }
    }
}

/// One request per connection.
fn serve(stream: &std::net::TcpStream, other: &Mutex<Other>) -> Option<()> {
    if other.lock().unwrap().cut {
        return None;
    }
    let mut reader = BufReader::new(stream);
    let mut length = 0;
    loop {
        let mut line = String::new();
        reader.read_line(&mut line).ok()?;
        if line.trim().is_empty() {
            break;
        }
        if let Some((name, value)) = line.split_once(':')
            && name.eq_ignore_ascii_case("content-length")
        {
            length = value.trim().parse().ok()?;
        }
    }
    let mut body = vec![0; length];
    reader.read_exact(&mut body).ok()?;
    let alarm = crate::alarm::Alarm::from_geojson(&body).ok()?;
    let (id, revision) = (alarm.properties.id, alarm.properties.revision);
    let (status, body) = match other.lock().unwrap().keep(&id, revision) {
        Verdict::Stored => (
            "201 Created",
            serde_json::json!({"id": id, "revision": revision, "stored": true}),
        ),
        Verdict::Refused(reason) | Verdict::Later(reason) => {
            ("409 Conflict", serde_json::json!({"error": reason}))
        }
    };
    let body = body.to_string();
    let answer = format!(
        "HTTP/1.1 {status}\r\ncontent-length: {}\r\nconnection: close\r\n\r\n{body}",
        body.len()
    );
    (&*stream).write_all(answer.as_bytes()).ok()
}

impl Bench for HttpBench {
    fn step(&mut self, waiting: &[Letter]) -> Vec<Settled> {
        std::thread::sleep(std::time::Duration::from_millis(5));
        // Twice as fast as it passes, to be through sooner; no pause here is short enough to mind.
        let passed = SignedDuration::try_from(2 * self.begun.elapsed()).unwrap();
        self.lanes.work(waiting, start() + passed)
    }

    fn other(&self) -> &Mutex<Other> {
        &self.other
    }
}

#[test]
fn the_fake_keeps_to_the_contract() {
    keeps_to_the_contract(|| {
        Box::new(FakeBench {
            other: Mutex::default(),
        })
    });
}

#[test]
fn datagrams_keep_to_the_contract_although_a_third_is_lost() {
    keeps_to_the_contract(|| Box::new(DatagramBench::new()));
}

#[test]
fn mavlink_keeps_to_the_contract() {
    keeps_to_the_contract(|| Box::new(MavlinkBench::new()));
}

#[test]
fn http_keeps_to_the_contract() {
    keeps_to_the_contract(|| Box::new(HttpBench::new()));
}
