/** Sorting and filtering the list of robots. */
import type { Robot, RobotState } from './types'

export type Shown = 'all' | RobotState

/** Robots that match the words and the state, reachable ones first, then by name. */
export function select(robots: Robot[], query: string, shown: Shown): Robot[] {
  const words = query.toLowerCase().split(/\s+/).filter(Boolean)
  return robots
    .filter((robot) => shown === 'all' || robot.state === shown)
    .filter((robot) => {
      const { name, description, host, platform, distro } = robot
      const users = robot.clients.map((client) => client.user)
      const text = [name, description, host, platform, distro, ...users].join(' ').toLowerCase()
      return words.every((word) => text.includes(word))
    })
    .sort(
      (a, b) =>
        Number(a.state === 'offline') - Number(b.state === 'offline') ||
        a.name.localeCompare(b.name, undefined, { numeric: true }),
    )
}

export function counts(robots: Robot[]): Record<Shown, number> {
  const of = (state: RobotState) => robots.filter((robot) => robot.state === state).length
  return { all: robots.length, online: of('online'), in_use: of('in_use'), offline: of('offline') }
}
