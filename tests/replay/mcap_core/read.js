// Reads a recording with @mcap/core and protobufjs, by what the file says of itself alone, and
// prints what it found as JSON: node read.js FILE [KEY OF THE SAMPLES]
import { open } from "node:fs/promises";

import { McapIndexedReader } from "@mcap/core";
import { decompress } from "fzstd";
import protobuf from "protobufjs";
import descriptor from "protobufjs/ext/descriptor.js";

const [path, samplesKey] = process.argv.slice(2);
const file = await open(path);

const readable = {
  size: async () => BigInt((await file.stat()).size),
  read: async (offset, length) => {
    const bytes = new Uint8Array(Number(length));
    const { bytesRead } = await file.read(bytes, 0, Number(length), Number(offset));
    if (bytesRead !== Number(length)) throw new Error("the file is shorter than it says");
    return bytes;
  },
};

const reader = await McapIndexedReader.Initialize({
  readable,
  decompressHandlers: { zstd: (bytes, size) => decompress(bytes, new Uint8Array(Number(size))) },
});

const types = new Map();
function typeOf(schema) {
  if (!types.has(schema.id)) {
    const root = protobuf.Root.fromDescriptor(descriptor.FileDescriptorSet.decode(schema.data));
    types.set(schema.id, root.lookupType(schema.name));
  }
  return types.get(schema.id);
}

const found = { messages: {}, samples: [], pictures: [], patches: 0, patch_bytes: 0 };
for await (const message of reader.readMessages()) {
  const channel = reader.channelsById.get(message.channelId);
  const schema = reader.schemasById.get(channel.schemaId);
  const value = typeOf(schema).decode(message.data);
  found.messages[schema.name] = (found.messages[schema.name] ?? 0) + 1;
  if (channel.topic === samplesKey) {
    const { seq, t_ns, x_mm, valid, circles } = value;
    found.samples.push([String(seq), String(t_ns), x_mm, valid, circles.length]);
  } else if (schema.name === "foxglove.CompressedImage") {
    found.pictures.push([value.format, Buffer.from(value.data).toString("base64")]);
  } else if (schema.name === "vdms.Pixels") {
    for (const patch of value.patches) {
      found.patches += 1;
      found.patch_bytes += patch.data.length === patch.width_px * patch.height_px;
    }
  }
}
for await (const attachment of reader.readAttachments()) {
  found.attachment = [attachment.name, attachment.mediaType, attachment.data.length];
}
for await (const metadata of reader.readMetadata()) {
  found.metadata = Object.fromEntries(metadata.metadata);
}
await file.close();
console.log(JSON.stringify(found));
