import { expect, it } from 'vitest'
import { readingsOf } from './device'

it('shows what was measured, with what is critical', () => {
  const readings = { signal: -80.4, cpu: 12.4, temperature: 91 }
  const critical = { signal: false, cpu: false, temperature: true, disk: true }
  expect(readingsOf({ at: 1, readings, critical })).toEqual([
    { name: 'cpu', title: 'Processor', words: '12 %', critical: false },
    { name: 'temperature', title: 'Temperature', words: '91 °C', critical: true },
    { name: 'signal', title: 'Wireless signal', words: '−80 dBm', critical: false },
  ])
})
