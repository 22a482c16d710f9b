#!/usr/bin/env python3
"""Reads one of the ground station's pictures the way a program that knows the standard would; prints JSON.

  geojson URL   geojson-pydantic (RFC 7946)
  kml URL       fastkml, and the OGC's own schema that comes with it; follows a NetworkLink
  cap URL       lxml with tests/data/cap/cap-1.2.xsd; URL is the Atom feed, every message in it is read
  metrics URL   the parser of prometheus-client
  foxglove URL  ws://..: subscribes to every channel, decodes with the published protobuf schemas
  takproto FILE every line a CoT event as JSON text; to TAK protobuf and back

Exit code 1 and the reason on stderr when it does not read.
"""

import argparse
import json
import struct
import sys
import time
import urllib.request
from pathlib import Path

HERE = Path(__file__).parent
CAP = "{urn:oasis:names:tc:emergency:cap:1.2}"
ATOM = "{http://www.w3.org/2005/Atom}"


def fetch(url):
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with opener.open(url, timeout=20) as response:
        return response.headers.get_content_type(), response.read()


def geojson(url):
    from geojson_pydantic import FeatureCollection

    kind, body = fetch(url)
    collection = FeatureCollection.model_validate_json(body)
    features = [f.model_dump() for f in collection.features]
    return {
        "content_type": kind,
        "features": [
            {
                "id": f.get("id"),
                "geometry": f["geometry"]["type"],
                "coordinates": f["geometry"]["coordinates"],
            }
            for f in features
        ],
    }


def kml(url):
    from fastkml import kml as fast
    from fastkml.containers import Document  # noqa: F401  (registers the classes)
    from fastkml.features import NetworkLink, Placemark
    from fastkml.utils import find_all
    from fastkml.validator import validate

    kind, body = fetch(url)
    document = fast.KML.from_string(body.split(b"?>", 1)[1].decode(), strict=True)
    assert validate(element=document.etree_element()), "not valid by the OGC schema"
    # The text as it came, not as fastkml would write it.
    from lxml import etree

    assert validate(element=etree.fromstring(body)), "not valid by the OGC schema"
    links = list(find_all(document, of_type=NetworkLink))
    places = [
        {
            "name": p.name,
            "description": p.description,
            "style": p.style_url.url if p.style_url else None,
            "geometries": [g.geom_type for g in getattr(p.geometry, "geoms", [p.geometry])],
            "shapes": [
                list(g.exterior.coords) if g.geom_type == "Polygon" else list(g.coords[0])
                for g in getattr(p.geometry, "geoms", [p.geometry])
            ],
        }
        for p in find_all(document, of_type=Placemark)
    ]
    out = {"content_type": kind, "placemarks": places}
    if links:
        link = links[0].link
        out["link"] = {
            "href": link.href,
            "interval_s": link.refresh_interval,
            "mode": link.refresh_mode.value,
        }
        out["linked"] = kml(link.href)
    return out


def cap(url):
    from lxml import etree

    schema = etree.XMLSchema(etree.parse(HERE.parent / "data" / "cap" / "cap-1.2.xsd"))
    kind, body = fetch(url)
    feed = etree.fromstring(body)
    assert feed.tag == ATOM + "feed", feed.tag
    messages = []
    for entry in feed.iter(ATOM + "entry"):
        message_kind, text = fetch(entry.find(ATOM + "link").get("href"))
        message = etree.fromstring(text)
        schema.assertValid(message)
        messages.append({"content_type": message_kind, **cap_facts(message)})
    return {"content_type": kind, "messages": list(reversed(messages))}


def cap_facts(message):
    def text(path):
        return message.findtext("/".join(CAP + step for step in path.split("/")))

    names = "identifier sender sent status msgType scope note references incidents".split()
    facts = {name: text(name) for name in names}
    for name in "event responseType urgency severity certainty headline".split():
        facts[name] = text(f"info/{name}")
    facts["circle"] = text("info/area/circle")
    facts["altitude_ft"] = text("info/area/altitude")
    return facts


def metrics(url):
    from prometheus_client.parser import text_string_to_metric_families

    kind, body = fetch(url)
    families = text_string_to_metric_families(body.decode())
    samples = [
        {"name": s.name, "labels": s.labels, "value": s.value, "type": f.type}
        for f in families
        for s in f.samples
    ]
    return {"content_type": kind, "samples": samples}


def foxglove(url, seconds=10):
    import websocket

    socket = websocket.create_connection(url, subprotocols=["foxglove.sdk.v1"], timeout=seconds)
    channels, newest = {}, {}
    end = time.monotonic() + seconds
    while time.monotonic() < end and not (channels and len(newest) == len(channels)):
        opcode, data = socket.recv_data()
        if opcode == websocket.ABNF.OPCODE_TEXT:
            message = json.loads(data)
            if message["op"] == "advertise":
                new = {c["id"]: c for c in message["channels"]}
                channels.update(new)
                asked = [{"id": i, "channelId": i} for i in new]
                socket.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
        elif data[0] == 1:
            subscription, _log_time = struct.unpack_from("<IQ", data, 1)
            newest[subscription] = data[13:]
    socket.close()
    return {"topics": {channels[i]["topic"]: foxglove_facts(channels[i], data) for i, data in newest.items()}}


def foxglove_facts(channel, data):
    import base64

    from foxglove_schemas_protobuf.GeoJSON_pb2 import GeoJSON
    from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    known = {"foxglove.GeoJSON": GeoJSON, "foxglove.LocationFix": LocationFix}
    kind = known.get(channel["schemaName"])
    if kind is None:
        # Not in the published Python package yet: by the schema that the channel carries.
        pool = descriptor_pool.DescriptorPool()
        for file in descriptor_pb2.FileDescriptorSet.FromString(base64.b64decode(channel["schema"])).file:
            pool.Add(file)
        kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"]))
    message = kind.FromString(data)
    if channel["schemaName"] == "foxglove.GeoJSON":
        return {"schema": channel["schemaName"], "geojson": json.loads(message.geojson)}
    fixes = [
        {
            "frame_id": f.frame_id,
            "place": [f.longitude, f.latitude, f.altitude],
            "covariance": list(f.position_covariance),
        }
        for f in getattr(message, "fixes", [message])
    ]
    return {"schema": channel["schemaName"], "fixes": fixes}


def takproto_read(file):
    import takproto

    events = []
    for line in Path(file).read_text().splitlines():
        xml = json.loads(line)
        for version in (takproto.TAKProtoVer.MESH, takproto.TAKProtoVer.STREAM):
            event = takproto.parse_proto(bytearray(takproto.xml2proto(xml, version))).cotEvent
        events.append(
            {
                "uid": event.uid, "type": event.type, "how": event.how, "lat": event.lat, "lon": event.lon,
                "hae": event.hae, "ce": event.ce, "le": event.le, "callsign": event.detail.contact.callsign,
                "stale_s": (event.staleTime - event.sendTime) / 1000, "detail": event.detail.xmlDetail,
            }
        )  # fmt: skip
    return {"events": events}


READERS = {
    "geojson": geojson, "kml": kml, "cap": cap, "metrics": metrics, "foxglove": foxglove, "takproto": takproto_read,
}  # fmt: skip


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kind", choices=READERS)
    parser.add_argument("source")
    args = parser.parse_args()
    try:
        print(json.dumps(READERS[args.kind](args.source), default=str))
    except Exception as error:  # whatever a reader says, it is the answer
        sys.exit(f"{args.kind}: {type(error).__name__}: {error}")


if __name__ == "__main__":
    main()
