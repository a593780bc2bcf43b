// Read logs with npm's @mcap/core, CRCs checked, and print what is in each as a line of JSON.
import { open } from "node:fs/promises";
import { McapIndexedReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";
import { loadDecompressHandlers } from "@mcap/support";

const decompressHandlers = await loadDecompressHandlers();
for (const path of process.argv.slice(2)) {
  const file = await open(path, "r");
  const reader = await McapIndexedReader.Initialize({ readable: new FileHandleReadable(file), decompressHandlers });
  const counts = {};
  let messages = 0;
  for await (const message of reader.readMessages({ validateCrcs: true })) {
    const topic = reader.channelsById.get(message.channelId).topic;
    counts[topic] = (counts[topic] ?? 0) + 1;
    messages += 1;
  }
  const attachments = [];
  for await (const attachment of reader.readAttachments()) attachments.push(attachment.name);
  const metadata = [];
  for await (const record of reader.readMetadata()) metadata.push(record.name);
  console.log(
    JSON.stringify({ messages, counted: Number(reader.statistics.messageCount), counts, attachments, metadata }),
  );
  await file.close();
}
