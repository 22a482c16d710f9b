//! The station's UDP port.
//!
//! **Bound:** [`UNDER_WAY`] datagrams at once. **Loss rule:** the newest are dropped unread and
//! counted; aircraft send again what is not answered.

use super::Station;
use crate::deliver::datagram::wire::RECEIVE_BUFFER;
use std::sync::Arc;
use std::time::Duration;
use tokio::net::UdpSocket;
use tokio::sync::Semaphore;

/// Datagrams that are worked on at once, most of the time waiting for the disk together.
const UNDER_WAY: usize = 1_024;
/// Pause after a socket error, so that a broken interface does not spin the processor.
const ERROR_PAUSE: Duration = Duration::from_millis(10);

/// Answers until the station stops.
pub(super) async fn run(station: Arc<Station>, socket: UdpSocket) {
    let mut stopping = station.stopping.subscribe();
    tokio::select! {
        () = answer_all(&station, Arc::new(socket)) => {}
        _ = stopping.wait_for(|stop| *stop) => {}
    }
}

async fn answer_all(station: &Arc<Station>, socket: Arc<UdpSocket>) {
    let room = Arc::new(Semaphore::new(UNDER_WAY));
    let mut buffer = vec![0; RECEIVE_BUFFER];
    loop {
        let (length, from) = match socket.recv_from(&mut buffer).await {
            Ok(received) => received,
            Err(error) => {
                tracing::debug!(%error, "receiving a datagram failed");
                tokio::time::sleep(ERROR_PAUSE).await;
                continue;
            }
        };
        let Ok(permit) = Arc::clone(&room).try_acquire_owned() else {
            station.reception.shed();
            continue;
        };
        let datagram = buffer[..length].to_vec();
        let (station, socket) = (Arc::clone(station), Arc::clone(&socket));
        tokio::spawn(async move {
            if let Some(answer) = station.reception.datagram(&station, &datagram).await
                && let Err(error) = socket.send_to(&answer, from).await
            {
                tracing::debug!(%error, "an answer was not sent");
            }
            drop(permit);
        });
    }
}
