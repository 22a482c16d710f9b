#!/usr/bin/env python3
"""Reads a recording with the Python `mcap` package, checks every CRC, and prints as JSON what is in it.

Images are decoded, calibrations and raw MAVLink frames parsed, JSON held against its schema. What does
not hold stands in `problems`; the exit code is 1 then, and 0 if there is none.
"""

import argparse
import json
import os
import sys

os.environ["MAVLINK20"] = "1"

from collections import Counter

import cv2
import jsonschema
import numpy as np
from mavclient import mavlink, print_json
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Chunk, DataEnd, Footer
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory

MOST_PROBLEMS = 20


class Topic:
    def __init__(self, schema, channel):
        self.schema = schema
        self.facts = {
            "schema": schema.name if schema else None,
            "schema_encoding": schema.encoding if schema else None,
            "message_encoding": channel.message_encoding,
            "count": 0,
        }

    def add(self, message):
        self.facts["count"] += 1
        for name in ("log_time", "publish_time"):
            self.facts.setdefault(f"first_{name}", getattr(message, name))
            self.facts[f"last_{name}"] = getattr(message, name)

    def tally(self, key, value):
        """Counts how often a value came up."""
        self.facts.setdefault(key, Counter())[str(value)] += 1


class Check:
    def __init__(self, path):
        self.path = path
        self.topics = {}
        self.problems = []
        self.decoders = {}
        self.stamps = {"left": [], "right": []}
        self.mavlink = mavlink.MAVLink(None)

    def problem(self, text):
        if len(self.problems) < MOST_PROBLEMS:
            self.problems.append(text)

    def run(self):
        records = self.check_records()
        with open(self.path, "rb") as stream:
            try:
                # In the order of the file: a reader that sorts gives nothing from one that was cut off.
                reader = NonSeekingReader(stream, validate_crcs=True)
                for schema, channel, message in reader.iter_messages(log_time_order=False):
                    self.add(schema, channel, message)
            except (McapError, ValueError, EOFError) as error:
                self.problem(f"reading: {type(error).__name__}: {error}")
        return {
            "file": self.path,
            "records": records,
            "summary": self.read_summary(),
            "topics": {name: topic.facts for name, topic in sorted(self.topics.items())},
            "pairs": self.pairs(),
            "problems": self.problems,
        }

    def check_records(self):
        """The file record by record: chunk and data CRCs, and whether it was finished."""
        facts = Counter()
        try:
            with open(self.path, "rb") as stream:
                for record in StreamReader(stream, emit_chunks=True, validate_crcs=True).records:
                    facts[type(record).__name__] += 1
                    if isinstance(record, Chunk):
                        facts["chunks_with_crc"] += record.uncompressed_crc != 0
                    if isinstance(record, DataEnd):
                        facts["data_section_has_crc"] += record.data_section_crc != 0
                    if isinstance(record, Footer):
                        facts["summary_has_crc"] += record.summary_crc != 0
        except (McapError, ValueError, EOFError) as error:
            self.problem(f"records: {type(error).__name__}: {error}")
        return facts

    def read_summary(self):
        with open(self.path, "rb") as stream:
            try:
                summary = make_reader(stream, validate_crcs=True).get_summary()
            except (McapError, ValueError, EOFError) as error:
                self.problem(f"summary: {type(error).__name__}: {error}")
                return None
        if summary is None or summary.statistics is None:
            return None
        statistics = summary.statistics
        counted = sum(topic.facts["count"] for topic in self.topics.values())
        if statistics.message_count != counted:
            self.problem(f"summary: says {statistics.message_count} messages, the file has {counted}")
        return {
            "messages": statistics.message_count,
            "first_log_time": statistics.message_start_time,
            "last_log_time": statistics.message_end_time,
            "chunks": statistics.chunk_count,
            "attachments": statistics.attachment_count,
            "metadata": statistics.metadata_count,
        }

    def add(self, schema, channel, message):
        topic = self.topics.setdefault(channel.topic, Topic(schema, channel))
        topic.add(message)
        try:
            if channel.message_encoding == "mavlink":
                self.add_mavlink(topic, message)
            elif channel.message_encoding == "json":
                self.add_json(topic, message)
            elif channel.message_encoding == "protobuf":
                self.add_protobuf(topic, channel, schema, message)
        except Exception as error:  # whatever a decoder says is a finding about the file
            self.problem(f"{channel.topic} at {message.log_time}: {type(error).__name__}: {error}")

    def add_mavlink(self, topic, message):
        """Each message has to be one whole frame."""
        frames = self.mavlink.parse_buffer(bytes(message.data)) or []
        if len(frames) != 1 or len(frames[0].get_msgbuf()) != len(message.data):
            raise ValueError(f"{len(message.data)} bytes hold {len(frames)} frames, not one")
        topic.tally("messages", frames[0].get_type())

    def add_json(self, topic, message):
        value = json.loads(message.data)
        if topic.schema and topic.schema.encoding == "jsonschema":
            jsonschema.validate(value, json.loads(topic.schema.data))
        topic.facts["last"] = value

    def add_protobuf(self, topic, channel, schema, message):
        if channel.id not in self.decoders:
            self.decoders[channel.id] = DecoderFactory().decoder_for(channel.message_encoding, schema)
        decoded = self.decoders[channel.id](message.data)
        if schema.name in ("foxglove.CompressedImage", "foxglove.RawImage"):
            self.add_image(topic, channel.topic, schema.name, message, decoded)
        elif schema.name == "foxglove.CameraCalibration":
            self.add_calibration(topic, decoded)

    def add_image(self, topic, name, schema, message, image):
        if schema == "foxglove.CompressedImage":
            pixels = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_UNCHANGED)
            if pixels is None:
                raise ValueError(f"{len(image.data)} bytes are no {image.format} image")
            height, width = pixels.shape[:2]
            topic.tally("formats", image.format)
        else:
            width, height = image.width, image.height
            if len(image.data) != image.step * height:
                raise ValueError(f"{len(image.data)} bytes, not {image.step} x {height}")
            topic.tally("formats", image.encoding)
        topic.tally("sizes", f"{width}x{height}")
        at = image.timestamp.ToNanoseconds()
        if at != message.publish_time:
            raise ValueError(f"timestamp {at} is not the publish time {message.publish_time}")
        for eye, stamps in self.stamps.items():
            if name == f"/stereo/{eye}/image":
                stamps.append(at)

    def add_calibration(self, topic, calibration):
        if len(calibration.K) != 9 or calibration.K[0] <= 0:
            raise ValueError("K is not a camera matrix")
        topic.facts["last"] = {
            "width": calibration.width,
            "height": calibration.height,
            "distortion_model": calibration.distortion_model,
            "K": list(calibration.K),
            "D": list(calibration.D),
            "R": list(calibration.R),
            "P": list(calibration.P),
            "frame_id": calibration.frame_id,
        }

    def pairs(self):
        left, right = (np.array(sorted(self.stamps[eye]), dtype=np.int64) for eye in ("left", "right"))
        if not len(left) or not len(right):
            return {"count": 0, "left": len(left), "right": len(right)}
        nearest = np.array([np.min(np.abs(right - at)) for at in left])
        return {
            "count": int(np.sum(nearest < 5_000_000)),
            "left": len(left),
            "right": len(right),
            "greatest_skew_ms": float(nearest.max() / 1e6),
        }


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file")
    result = Check(parser.parse_args().file).run()
    print_json(result)
    sys.exit(1 if result["problems"] else 0)


if __name__ == "__main__":
    main()
