// Reads a recording with @mcap/core, the library of Foxglove and Lichtblick; prints what it contains.
const fs = require("fs");
const { McapIndexedReader, McapStreamReader, decompress } = require("./vendor/mcap-core-2.2.2.cjs");

const bytes = fs.readFileSync(process.argv[2]);
const decompressHandlers = {
  zstd: (data, size) => decompress(data, new Uint8Array(Number(size))),
};
const text = (data) => Buffer.from(data).toString("utf-8");

function readStream() {
  const reader = new McapStreamReader({ validateCrcs: true, decompressHandlers });
  reader.append(bytes);
  const counts = {};
  for (let record; (record = reader.nextRecord()); ) {
    counts[record.type] = (counts[record.type] ?? 0) + 1;
  }
  return { counts, done: reader.done() };
}

async function readIndexed() {
  const reader = await McapIndexedReader.Initialize({
    readable: {
      size: async () => BigInt(bytes.length),
      read: async (offset, size) => new Uint8Array(bytes.subarray(Number(offset), Number(offset + size))),
    },
    decompressHandlers,
  });
  const channels = [...reader.channelsById.values()].map((channel) => {
    const schema = reader.schemasById.get(channel.schemaId);
    return [channel.topic, channel.messageEncoding, schema.name, schema.encoding, JSON.parse(text(schema.data)).type];
  });
  const messages = { tick: [], event: [] };
  for await (const message of reader.readMessages({ topics: Object.keys(messages) })) {
    const topic = reader.channelsById.get(message.channelId).topic;
    messages[topic].push([Number(message.logTime), JSON.parse(text(message.data))]);
  }
  const metadata = {};
  for await (const { name, metadata: entries } of reader.readMetadata()) metadata[name] = Object.fromEntries(entries);
  const attachments = {};
  for await (const { name, data } of reader.readAttachments()) attachments[name] = text(data);
  return { channels, messages, metadata, attachments };
}

(async () => {
  const stream = readStream();
  console.log(JSON.stringify({ stream, indexed: stream.done ? await readIndexed() : null }));
})();
