// @mcap/core with Foxglove's decoder of ROS 2 messages. Argument: path of an MCAP file.
// Prints stamps and points of all clouds, messages by topic, and the first point of each cloud.
import { open } from "node:fs/promises";
import { McapIndexedReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";
import { parse } from "@foxglove/rosmsg";
import { MessageReader } from "@foxglove/rosmsg2-serialization";

const file = await open(process.argv[2], "r");
const reader = await McapIndexedReader.Initialize({ readable: new FileHandleReadable(file) });
const decoders = new Map();
for (const channel of reader.channelsById.values()) {
  const schema = reader.schemasById.get(channel.schemaId);
  const text = new TextDecoder().decode(schema.data);
  decoders.set(channel.id, new MessageReader(parse(text, { ros2: true })));
}
const found = { points: [], stamps_ns: [], first: [], last_time_s: [], messages: {}, fields: [] };
for await (const message of reader.readMessages()) {
  const topic = reader.channelsById.get(message.channelId).topic;
  found.messages[topic] = (found.messages[topic] ?? 0) + 1;
  const decoded = decoders.get(message.channelId).readMessage(message.data);
  if (topic !== "/points") {
    continue;
  }
  const view = new DataView(decoded.data.buffer, decoded.data.byteOffset, decoded.data.byteLength);
  const count = decoded.width * decoded.height;
  const offset = Object.fromEntries(decoded.fields.map((field) => [field.name, field.offset]));
  found.fields = decoded.fields.map((field) => field.name);
  found.points.push(count);
  found.stamps_ns.push(message.logTime.toString());
  found.first.push(["x", "y", "z"].map((axis) => view.getFloat32(offset[axis], true)));
  found.last_time_s.push(view.getFloat32((count - 1) * decoded.point_step + offset.time, true));
}
await file.close();
console.log(JSON.stringify(found));
