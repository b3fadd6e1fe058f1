/** Messages over the page: the latest few, each once. */

export interface Toast {
  id: number
  kind: 'info' | 'warning' | 'error'
  words: string
  /** A page of the portal that tells more, and what leads there. */
  more: { path: string; label: string } | null
  /** Null: it goes by itself after a moment. Else it stays until it is dismissed, or all of these robots stand. */
  until: readonly string[] | null
  /** How often the same was said. */
  times: number
}

export type Told = Omit<Toast, 'id' | 'times'>

const SHOWN = 3

/** With one more; what is said again is counted. What stays makes room for what stays alone, and for a moment
 * there is one more beside it.
 *
 * @param id of the new one, where it is new
 */
export function added(toasts: Toast[], told: Told, id: number): { toasts: Toast[]; toast: Toast } {
  const same = toasts.find((toast) => toast.words === told.words)
  if (same !== undefined) {
    const toast = { ...same, ...told, times: same.times + 1 }
    return { toasts: toasts.map((each) => (each.id === same.id ? toast : each)), toast }
  }
  const toast = { ...told, id, times: 1 }
  const room = [...toasts, toast]
  while (room.length > SHOWN) {
    const passing = room.findIndex((each) => each.until === null)
    if (room[passing] === toast) break
    room.splice(Math.max(passing, 0), 1)
  }
  return { toasts: room, toast }
}

/** Without what was said of robots that were not known to stand, and do; the same list where that is none. */
export function settled(toasts: Toast[], standing: readonly string[]): Toast[] {
  const known = new Set(standing)
  const over = (until: readonly string[] | null) => until !== null && until.length > 0 && until.every((name) => known.has(name))
  return toasts.some(({ until }) => over(until)) ? toasts.filter(({ until }) => !over(until)) : toasts
}
