/** Decodes CBOR (RFC 8949) as the relay sends it (SPEC 1.6). roslib calls it for binary messages.
 *
 * Arrays of numbers (RFC 8746, little endian) become typed arrays without being copied where their position allows it.
 */

const VIEWS = {
  64: Uint8Array,
  69: Uint16Array,
  70: Uint32Array,
  71: BigUint64Array,
  72: Int8Array,
  77: Int16Array,
  78: Int32Array,
  79: BigInt64Array,
  85: Float32Array,
  86: Float64Array,
} as const

const SIMPLE = new Map<number, unknown>([
  [20, false],
  [21, true],
  [22, null],
  [23, undefined],
])
const DEPTH = 64
const TEXT = new TextDecoder()

/** @throws Error for what is no CBOR, or a form that the relay does not send (indefinite lengths, other tags) */
export function decode(bytes: Uint8Array): unknown {
  const reader = new Reader(bytes)
  const value = reader.value(0)
  if (reader.at !== bytes.length) throw new Error('There are bytes after the end of the CBOR value.')
  return value
}

class Reader {
  at = 0
  private readonly view: DataView

  constructor(private readonly bytes: Uint8Array) {
    this.view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength)
  }

  value(depth: number): unknown {
    if (depth > DEPTH) throw new Error('The CBOR value is nested too deeply.')
    const head = this.view.getUint8(this.at++)
    const major = head >> 5
    const info = head & 31
    if (major === 7) return this.simple(info)
    const count = this.count(info)
    switch (major) {
      case 0:
        return count
      case 1:
        return -1 - count
      case 2:
        return this.take(count)
      case 3:
        return TEXT.decode(this.take(count))
      case 4:
        return this.list(count, depth)
      case 5:
        return this.record(count, depth)
      default:
        return this.tagged(count, depth)
    }
  }

  private list(count: number, depth: number): unknown[] {
    const found: unknown[] = []
    for (let i = 0; i < count; i++) found.push(this.value(depth + 1))
    return found
  }

  private record(count: number, depth: number): Record<string, unknown> {
    const entries: [string, unknown][] = []
    for (let i = 0; i < count; i++) entries.push([String(this.value(depth + 1)), this.value(depth + 1)])
    // Unlike assignment, this makes `__proto__` an ordinary field.
    return Object.fromEntries(entries)
  }

  private tagged(tag: number, depth: number): unknown {
    const View = VIEWS[tag as keyof typeof VIEWS]
    const body = this.value(depth + 1)
    if (View === undefined || !(body instanceof Uint8Array)) throw new Error(`The CBOR tag ${tag} is not known.`)
    const size = View.BYTES_PER_ELEMENT
    const aligned = body.byteOffset % size === 0 ? body : body.slice()
    const numbers = new View(aligned.buffer as ArrayBuffer, aligned.byteOffset, Math.floor(aligned.byteLength / size))
    return numbers instanceof BigInt64Array || numbers instanceof BigUint64Array ? Array.from(numbers, Number) : numbers
  }

  private simple(info: number): unknown {
    if (SIMPLE.has(info)) return SIMPLE.get(info)
    const at = this.at
    if (info === 25) {
      this.at += 2
      return half(this.view.getUint16(at))
    }
    if (info === 26) {
      this.at += 4
      return this.view.getFloat32(at)
    }
    if (info === 27) {
      this.at += 8
      return this.view.getFloat64(at)
    }
    throw new Error(`The simple CBOR value ${info} is not known.`)
  }

  private count(info: number): number {
    const at = this.at
    if (info < 24) return info
    if (info > 27) throw new Error('CBOR of indefinite length is not known.')
    this.at += 1 << (info - 24)
    if (info === 24) return this.view.getUint8(at)
    if (info === 25) return this.view.getUint16(at)
    return info === 26 ? this.view.getUint32(at) : Number(this.view.getBigUint64(at))
  }

  private take(count: number): Uint8Array {
    if (this.at + count > this.bytes.length) throw new Error('The CBOR value is cut off.')
    this.at += count
    return this.bytes.subarray(this.at - count, this.at)
  }
}

/** IEEE 754 binary16. */
function half(bits: number): number {
  const sign = bits & 0x8000 ? -1 : 1
  const exponent = (bits >> 10) & 31
  const fraction = bits & 1023
  if (exponent === 0) return sign * fraction * 2 ** -24
  if (exponent === 31) return fraction === 0 ? sign * Infinity : NaN
  return sign * (1 + fraction / 1024) * 2 ** (exponent - 15)
}
