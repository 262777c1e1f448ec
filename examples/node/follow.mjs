// Follows the displacements of a station without any library: node follow.mjs HOST [PORT]
//
// Where there is a zenoh client for your language, use it, and compile vdms.proto. This shows how
// little is needed where there is none: a session of zenoh's protocol (version 9) that subscribes, and
// the few fields of vdms.Displacement that it prints. It reads what is said live; history and recovery
// are what a zenoh client adds.

import { randomBytes } from 'node:crypto'
import { connect } from 'node:net'

const KEY = 'vdms/*/*/displacement'
const VERSION = 9
const CLIENT = 2
const LEASE_S = 10
const [INIT, OPEN, CLOSE, KEEP_ALIVE, FRAME] = [1, 2, 3, 4, 5]
const [PUSH, DECLARE, SUBSCRIBER, PUT] = [0x1d, 0x1e, 2, 1]
const [FLAG_5, FLAG_6, EXTENDED] = [0x20, 0x40, 0x80] // what they mean depends on the message

class Reader {
  constructor(bytes) {
    this.bytes = bytes
    this.at = 0
  }
  get left() {
    return this.bytes.length - this.at
  }
  byte() {
    return this.bytes[this.at++]
  }
  number() { // seven bits a byte, the least significant first
    let value = 0n
    for (let shift = 0n; ; shift += 7n) {
      const byte = this.byte()
      value |= BigInt(shift < 56n ? byte & 0x7f : byte) << shift
      if (byte < 0x80 || shift === 56n) return value
    }
  }
  take(length) {
    this.at += Number(length)
    return this.bytes.subarray(this.at - Number(length), this.at)
  }
  buffer() {
    return this.take(this.number())
  }
  key(header) {
    this.number()
    if (header & FLAG_5) this.buffer()
  }
  extensions(header) {
    while (header & EXTENDED) {
      header = this.byte()
      if ((header & 0x60) === 0x20) this.number()
      else if ((header & 0x60) === 0x40) this.buffer()
    }
  }
}

function number(value) {
  const bytes = []
  for (; value > 0x7f; value = Math.floor(value / 128)) bytes.push((value & 0x7f) | 0x80)
  return Buffer.from([...bytes, value])
}

function buffer(bytes) {
  return Buffer.concat([number(bytes.length), Buffer.from(bytes)])
}

function displacement(bytes) {
  const reader = new Reader(bytes)
  const fields = {}
  while (reader.left > 0) {
    const tag = Number(reader.number())
    const view = new DataView(bytes.buffer, bytes.byteOffset + reader.at)
    switch (tag & 7) {
      case 0: fields[tag >> 3] = reader.number(); break
      case 1:
        fields[tag >> 3] = [12, 13].includes(tag >> 3) ? view.getFloat64(0, true) : view.getBigUint64(0, true)
        reader.take(8)
        break
      case 2: fields[tag >> 3] = reader.buffer(); break
      case 5: reader.take(4)
    }
  }
  return {
    session: fields[1] ?? 0n,
    marker: String(fields[2] ?? ''),
    seq: fields[3] ?? 0n,
    t_ns: fields[8] ?? 0n,
    x_mm: fields[12] ?? 0,
    y_mm: fields[13] ?? 0,
    valid: fields[18] === 1n,
  }
}

function declaration(reader, header) {
  if (header & FLAG_5) reader.number()
  reader.extensions(header)
  const kind = reader.byte()
  if ((kind & 0x1f) !== 0x1a) {
    reader.number()
    if (!(kind & 1)) reader.key(kind) // odd ones take back
  }
  reader.extensions(kind)
}

function* samples(reader) {
  while (reader.left > 0) {
    const header = reader.byte()
    if ((header & 0x1f) === DECLARE) {
      declaration(reader, header)
      continue
    }
    if ((header & 0x1f) !== PUSH) return // nothing that a subscriber needs
    reader.key(header)
    reader.extensions(header)
    const body = reader.byte()
    if ((body & 0x1f) !== PUT) return
    if (body & FLAG_5) {
      reader.number()
      reader.buffer()
    }
    if (body & FLAG_6 && reader.number() & 1n) reader.buffer()
    reader.extensions(body)
    yield displacement(reader.buffer())
  }
}

function* messages(batch) {
  const reader = new Reader(batch)
  const header = reader.byte()
  if ((header & 0x1f) !== FRAME) {
    yield { kind: header & 0x1f, header, reader }
    return
  }
  reader.number()
  reader.extensions(header)
  yield { kind: FRAME, reader }
}

export function follow(host, port, onSample) {
  const socket = connect(port, host)
  const send = (...parts) => {
    const batch = Buffer.concat(parts.map((part) => Buffer.from(part)))
    const length = Buffer.alloc(2)
    length.writeUInt16LE(batch.length)
    socket.write(Buffer.concat([length, batch]))
  }
  const zid = randomBytes(16)
  socket.on('connect', () => send([INIT, VERSION, CLIENT | (zid.length - 1) << 4], zid))
  const beat = setInterval(() => send([KEEP_ALIVE]), LEASE_S * 250)
  socket.on('close', () => clearInterval(beat))

  function take(batch) {
    for (const { kind, header, reader } of messages(batch)) {
      if (kind === INIT) {
        reader.byte()
        reader.take((reader.byte() >> 4) + 1)
        if (header & FLAG_6) reader.take(3)
        send([OPEN | FLAG_6, LEASE_S, 0], buffer(reader.buffer()))
      } else if (kind === OPEN) {
        send([FRAME | FLAG_5, 0, DECLARE, SUBSCRIBER | FLAG_5, 1, 0], buffer(KEY))
      } else if (kind === FRAME) {
        for (const sample of samples(reader)) onSample(sample)
      } else if (kind === CLOSE) {
        socket.end()
      }
    }
  }
  let received = Buffer.alloc(0)
  socket.on('data', (data) => {
    received = Buffer.concat([received, data])
    while (received.length >= 2 && received.length >= 2 + received.readUInt16LE()) {
      const end = 2 + received.readUInt16LE()
      take(received.subarray(2, end))
      received = received.subarray(end)
    }
  })
  return socket
}

if (process.argv[1]?.endsWith('follow.mjs')) {
  const [host = '127.0.0.1', port = '7447'] = process.argv.slice(2)
  follow(host, Number(port), (d) => {
    console.log(`${d.session} ${d.marker} ${d.seq} ${d.x_mm} ${d.y_mm} ${d.valid}`)
  }).on('error', (error) => {
    console.error(`${host}:${port}: ${error.message}`)
    process.exitCode = 1
  })
}
