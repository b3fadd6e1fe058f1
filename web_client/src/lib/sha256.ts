/** SHA-256 (FIPS 180-4), part by part: `crypto.subtle` hashes only whole values, and only on pages that came by HTTPS. */

const K = new Uint32Array(64)
const START = new Uint32Array(8)
fillConstants()

/** The first 32 bits of the fractional parts of roots of primes. */
function fillConstants() {
  let found = 0
  for (let candidate = 2; found < 64; candidate++) {
    if (!isPrime(candidate)) continue
    K[found] = fraction(Math.cbrt(candidate))
    if (found < 8) START[found] = fraction(Math.sqrt(candidate))
    found++
  }
}

function isPrime(value: number): boolean {
  for (let divisor = 2; divisor * divisor <= value; divisor++) if (value % divisor === 0) return false
  return true
}

function fraction(value: number): number {
  return (value - Math.floor(value)) * 2 ** 32
}

export class Sha256 {
  private readonly state = START.slice()
  private readonly words = new Uint32Array(64)
  private readonly rest = new Uint8Array(64)
  private held = 0
  private bytes = 0

  update(data: Uint8Array): this {
    this.bytes += data.length
    let offset = 0
    if (this.held > 0) {
      offset = Math.min(64 - this.held, data.length)
      this.rest.set(data.subarray(0, offset), this.held)
      this.held += offset
      if (this.held < 64) return this
      this.compress(this.rest, 0)
    }
    for (; offset + 64 <= data.length; offset += 64) this.compress(data, offset)
    this.held = data.length - offset
    this.rest.set(data.subarray(offset))
    return this
  }

  /** The hash in hexadecimal; nothing more may be added. */
  hex(): string {
    const bits = this.bytes * 8
    const padding = new Uint8Array(this.held < 56 ? 64 - this.held : 128 - this.held)
    padding[0] = 0x80
    const view = new DataView(padding.buffer)
    view.setUint32(padding.length - 8, Math.floor(bits / 2 ** 32))
    view.setUint32(padding.length - 4, bits >>> 0)
    this.update(padding)
    return Array.from(this.state, (word) => word.toString(16).padStart(8, '0')).join('')
  }

  private compress(data: Uint8Array, offset: number) {
    const w = this.words
    for (let i = 0; i < 16; i++) {
      const at = offset + 4 * i
      w[i] = (data[at]! << 24) | (data[at + 1]! << 16) | (data[at + 2]! << 8) | data[at + 3]!
    }
    for (let i = 16; i < 64; i++) {
      const [x, y] = [w[i - 15]!, w[i - 2]!]
      const s0 = ((x >>> 7) | (x << 25)) ^ ((x >>> 18) | (x << 14)) ^ (x >>> 3)
      const s1 = ((y >>> 17) | (y << 15)) ^ ((y >>> 19) | (y << 13)) ^ (y >>> 10)
      w[i] = (w[i - 16]! + s0 + w[i - 7]! + s1) | 0
    }
    let [a, b, c, d, e, f, g, h] = this.state as unknown as [number, number, number, number, number, number, number, number]
    for (let i = 0; i < 64; i++) {
      const s1 = ((e >>> 6) | (e << 26)) ^ ((e >>> 11) | (e << 21)) ^ ((e >>> 25) | (e << 7))
      const t1 = (h + s1 + ((e & f) ^ (~e & g)) + K[i]! + w[i]!) | 0
      const s0 = ((a >>> 2) | (a << 30)) ^ ((a >>> 13) | (a << 19)) ^ ((a >>> 22) | (a << 10))
      const t2 = (s0 + ((a & b) ^ (a & c) ^ (b & c))) | 0
      ;[h, g, f, e, d, c, b, a] = [g, f, e, (d + t1) | 0, c, b, a, (t1 + t2) | 0]
    }
    ;[a, b, c, d, e, f, g, h].forEach((value, i) => (this.state[i] = (this.state[i]! + value) | 0))
  }
}
