/** Readings of a robot's computer, without user interface. */
import { ask, Refusal } from './request'
import type { DeviceInfo } from './types'

export interface Reading {
  name: string
  title: string
  words: string
  critical: boolean
}

const COMPONENTS: [string, string, string][] = [
  ['battery', 'Battery', '%'],
  ['cpu', 'Processor', '%'],
  ['memory', 'Memory in use', '%'],
  ['disk', 'Disk in use', '%'],
  ['temperature', 'Temperature', '°C'],
  ['signal', 'Wireless signal', 'dBm'],
  ['quality', 'Wireless quality', ''],
]

/** What was measured; components that can't be read are left out. */
export function readingsOf(device: DeviceInfo): Reading[] {
  return COMPONENTS.flatMap(([name, title, unit]) => {
    const value = device.readings[name]
    if (value === undefined) return []
    const words = `${Math.round(value)} ${unit}`.trim().replace('-', '−')
    return [{ name, title, words, critical: device.critical[name] === true }]
  })
}

/** The readings of a robot, null while there are none. */
export async function device(robot: string): Promise<DeviceInfo | null> {
  try {
    return (await ask('get', '/api/v1/robots/{robot}/device', { names: { robot } })) as DeviceInfo
  } catch (error) {
    if (error instanceof Refusal && error.status === 503) return null
    throw error
  }
}
