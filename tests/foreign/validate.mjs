// Opens logs as a viewer would, checks their checksums, and says what it found: a line of JSON each.
import { readFile } from "node:fs/promises";

import { McapIndexedReader, McapStreamReader } from "@mcap/core";
import { loadDecompressHandlers } from "@mcap/support";
import protobuf from "protobufjs";
import "protobufjs/ext/descriptor/index.js";

const decompressHandlers = await loadDecompressHandlers();

function streamed(bytes) {
  const reader = new McapStreamReader({ decompressHandlers, validateCrcs: true });
  reader.append(bytes);
  const messages = new Map();
  const topics = new Map();
  for (let record; (record = reader.nextRecord()) != undefined; ) {
    if (record.type === "Channel") topics.set(record.id, record.topic);
    if (record.type === "Message") {
      const topic = topics.get(record.channelId);
      messages.set(topic, (messages.get(topic) ?? 0) + 1);
    }
  }
  if (!reader.done()) throw new Error("the file has no end");
  return Object.fromEntries(messages);
}

function decoder(schema) {
  const set = protobuf.FileDescriptorSet ?? protobuf.descriptor?.FileDescriptorSet;
  const type = protobuf.Root.fromDescriptor(set.decode(schema.data)).lookupType(schema.name);
  const fields = type.fieldsArray.map((field) => field.name);
  return (data) => {
    const message = type.decode(data);
    return Object.fromEntries(fields.map((name) => [snake(name), plain(message[name])]));
  };
}

const snake = (name) => name.replace(/[A-Z]/g, (letter) => "_" + letter.toLowerCase());
const plain = (value) => (typeof value === "object" ? Number(value.toString()) : value);

async function inspect(path) {
  const bytes = await readFile(path);
  const file = {
    size: async () => BigInt(bytes.byteLength),
    read: async (offset, size) => bytes.subarray(Number(offset), Number(offset + size)),
  };
  const reader = await McapIndexedReader.Initialize({ readable: file, decompressHandlers });
  const messages = {};
  let first, last, keyframe;
  for await (const message of reader.readMessages({ validateCrcs: true })) {
    const channel = reader.channelsById.get(message.channelId);
    const schema = reader.schemasById.get(channel.schemaId);
    messages[channel.topic] = (messages[channel.topic] ?? 0) + 1;
    if (channel.messageEncoding === "json") {
      const value = JSON.parse(new TextDecoder().decode(message.data));
      if (channel.topic === "/pam/keyframe") keyframe = value;
    } else {
      channel.decode ??= decoder(schema);
      last = channel.decode(message.data);
      first ??= last;
    }
  }
  const attachments = [];
  for await (const attachment of reader.readAttachments({ validateCrcs: true })) {
    attachments.push(attachment.name);
  }
  if (JSON.stringify(Object.entries(streamed(bytes)).sort()) !== JSON.stringify(Object.entries(messages).sort())) {
    throw new Error("the index and the file disagree");
  }
  console.log(JSON.stringify({ messages, attachments, first, last, keyframe }));
}

for (const path of process.argv.slice(2)) await inspect(path);
