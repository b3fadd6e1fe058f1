import { decode as reference } from 'cbor2'
import { describe, expect, it } from 'vitest'
import { decode } from './cbor'

const bytes = (hex: string) => Uint8Array.from(hex.match(/../g) ?? [], (pair) => parseInt(pair, 16))

describe('CBOR', () => {
  it.each(['00', '1818', '190100', '1a00010000', '1b0000000100000000', '20', '3903e7', 'f4', 'f5', 'f6', 'f93c00', 'f90001', 'fa47c35000', 'fb3ff199999999999a', '6449455446', '83010203', 'a26161016162820203', '4401020304'])(
    'is read as other decoders read it: %s',
    (hex) => {
      expect(decode(bytes(hex))).toEqual(reference(bytes(hex)))
    },
  )

  it('reads infinity and NaN', () => {
    expect(decode(bytes('f97c00'))).toBe(Infinity)
    expect(decode(bytes('f9fc00'))).toBe(-Infinity)
    expect(decode(bytes('f97e00'))).toBeNaN()
  })

  it('gives an array of int8 without copying it', () => {
    const message = bytes('a16464617461d84843ff0064')
    const { data } = decode(message) as { data: Int8Array }
    expect(data).toEqual(Int8Array.of(-1, 0, 100))
    expect(data.buffer).toBe(message.buffer)
  })

  it('gives arrays of wider numbers wherever they begin', () => {
    expect(decode(bytes('d84d440100feff'))).toEqual(Int16Array.of(1, -2))
    expect(decode(bytes('d85548000000400000803f'))).toEqual(Float32Array.of(2, 1))
    expect(decode(bytes('d84f48ffffffffffffffff'))).toEqual([-1])
  })

  it.each(['', '18', '4401', '9f01ff', 'c001', '0000'])('refuses what is none: %j', (hex) => {
    expect(() => decode(bytes(hex))).toThrow()
  })

  it('keeps a field that is called __proto__', () => {
    expect(Object.keys(decode(bytes('a1695f5f70726f746f5f5f01')) as object)).toEqual(['__proto__'])
  })
})
