#!/usr/bin/env python3
"""What stands around a TAK server, for tests.

  certificates DIR           a CA, a server's and two clients' certificates (PEM)
  relay DIR [--port 0]       a small server: TLS, client certificates required; what one client says, the others hear
  pytak DIR --port P         pytak, unmodified, as a client of it: prints every event that it received
  multicast GROUP:PORT       joins the group and prints every datagram

`relay`, `pytak` and `multicast` print `ready {..}` on stderr, run for --seconds or until --count events have come,
and end with JSON on stdout; SIGTERM ends them sooner.
"""

import argparse
import asyncio
import configparser
import datetime
import ipaddress
import json
import signal
import socket
import ssl
import sys
from pathlib import Path


def say_ready(**facts):
    print("ready " + json.dumps(facts), file=sys.stderr, flush=True)


# --- certificates --------------------------------------------------------------------------------


def certificates(args):
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import NameOID

    folder = Path(args.folder)
    folder.mkdir(parents=True, exist_ok=True)
    now = datetime.datetime.now(datetime.UTC)

    def make(name, issuer=None):
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        builder = (
            x509.CertificateBuilder()
            .subject_name(subject)
            .issuer_name(issuer[0].subject if issuer else subject)
            .public_key(key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - datetime.timedelta(hours=1))
            .not_valid_after(now + datetime.timedelta(days=1))
            .add_extension(x509.BasicConstraints(ca=issuer is None, path_length=None), critical=True)
        )
        if issuer:
            names = [x509.DNSName("localhost"), x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]
            builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
        certificate = builder.sign(issuer[1] if issuer else key, hashes.SHA256())
        (folder / f"{name}.pem").write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
        (folder / f"{name}.key").write_bytes(
            key.private_bytes(
                serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
            )
        )
        return certificate, key

    ca = make("ca")
    for name in ("server", "ground", "viewer"):
        make(name, ca)
    make("stranger")
    return {"folder": str(folder)}


# --- server --------------------------------------------------------------------------------------


class Relay:
    def __init__(self):
        self.clients = {}
        self.seen = []

    async def serve(self, reader, writer):
        name = dict(x[0] for x in writer.get_extra_info("peercert")["subject"])["commonName"]
        self.clients[writer] = name
        self.seen.append(name)
        try:
            while data := await reader.read(65536):
                for other in [w for w in self.clients if w is not writer]:
                    other.write(data)
        except (ConnectionError, ssl.SSLError):
            pass
        finally:
            del self.clients[writer]
            writer.close()


async def relay(args, stop):
    folder = Path(args.folder)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(folder / "server.pem", folder / "server.key")
    context.load_verify_locations(folder / "ca.pem")
    context.verify_mode = ssl.CERT_REQUIRED
    hub = Relay()
    server = await asyncio.start_server(hub.serve, "127.0.0.1", args.port, ssl=context)
    say_ready(port=server.sockets[0].getsockname()[1])
    await wait(stop, args.seconds)
    return {"clients": hub.seen}


async def wait(stop, seconds):
    try:
        await asyncio.wait_for(stop.wait(), seconds)
    except TimeoutError:
        pass


# --- clients -------------------------------------------------------------------------------------


async def pytak_client(args, stop):
    import pytak

    folder = Path(args.folder)
    parser = configparser.ConfigParser()
    parser["viewer"] = {
        "COT_URL": f"tls://127.0.0.1:{args.port}",
        "PYTAK_TLS_CLIENT_CERT": str(folder / "viewer.pem"),
        "PYTAK_TLS_CLIENT_KEY": str(folder / "viewer.key"),
        "PYTAK_TLS_CLIENT_CAFILE": str(folder / "ca.pem"),
        "PYTAK_TLS_DONT_CHECK_HOSTNAME": "1",
    }
    tool = pytak.CLITool(parser["viewer"])
    await tool.setup()
    say_ready()
    running = asyncio.ensure_future(tool.run())
    events = []
    ends = asyncio.get_event_loop().time() + args.seconds
    while not stop.is_set() and len(events) < args.count and asyncio.get_event_loop().time() < ends:
        try:
            event = await asyncio.wait_for(tool.rx_queue.get(), 0.2)
        except TimeoutError:
            continue
        events.append(event.decode() if isinstance(event, bytes) else event)
    running.cancel()
    return {"events": events}


async def multicast(args, stop):
    group, port = args.folder.rsplit(":", 1)
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    receiver.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    receiver.bind(("", int(port)))
    if ipaddress.ip_address(group).is_multicast:
        member = socket.inet_aton(group) + socket.inet_aton(args.interface)
        receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
    receiver.setblocking(False)
    say_ready()
    loop, datagrams = asyncio.get_event_loop(), []
    ends = loop.time() + args.seconds
    while not stop.is_set() and len(datagrams) < args.count and loop.time() < ends:
        try:
            datagrams.append((await asyncio.wait_for(loop.sock_recv(receiver, 65536), 0.2)).decode())
        except TimeoutError:
            continue
    return {"events": datagrams}


async def run(work, args):
    stop = asyncio.Event()
    asyncio.get_event_loop().add_signal_handler(signal.SIGTERM, stop.set)
    return await work(args, stop)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=["certificates", "relay", "pytak", "multicast"])
    parser.add_argument("folder", metavar="DIR or GROUP:PORT")
    parser.add_argument("--port", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--interface", default="127.0.0.1")
    args = parser.parse_args()
    if args.what == "certificates":
        print(json.dumps(certificates(args)))
        return
    work = {"relay": relay, "pytak": pytak_client, "multicast": multicast}[args.what]
    print(json.dumps(asyncio.run(run(work, args))))


if __name__ == "__main__":
    main()
