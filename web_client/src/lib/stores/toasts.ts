/** Messages in a corner of the page: the latest few, each once. */

export interface Toast {
  id: number
  kind: 'info' | 'warning' | 'error'
  words: string
  /** A page of the portal with details, and the label of the link. */
  more: { path: string; label: string } | null
  /** Null: the message disappears after a moment. Otherwise it stays until it is dismissed, or all these robots are stopped. */
  until: readonly string[] | null
  /** How often the same message came. */
  times: number
}

export type NewToast = Omit<Toast, 'id' | 'times'>

const SHOWN = 3

/** The list with another message; an equal one is only counted. A message that stays is replaced only by another one
 * that stays, so for a moment there may be one message more.
 *
 * @param id id of the message, if it is new
 */
export function added(toasts: Toast[], message: NewToast, id: number): { toasts: Toast[]; toast: Toast } {
  const same = toasts.find((toast) => toast.words === message.words)
  if (same !== undefined) {
    const toast = { ...same, ...message, times: same.times + 1 }
    return { toasts: toasts.map((each) => (each.id === same.id ? toast : each)), toast }
  }
  const toast = { ...message, id, times: 1 }
  const room = [...toasts, toast]
  while (room.length > SHOWN) {
    const passing = room.findIndex((each) => each.until === null)
    if (room[passing] === toast) break
    room.splice(Math.max(passing, 0), 1)
  }
  return { toasts: room, toast }
}

/** The list without messages about robots that are stopped by now; the same list if there are none. */
export function settled(toasts: Toast[], standing: readonly string[]): Toast[] {
  const known = new Set(standing)
  const over = (until: readonly string[] | null) => until !== null && until.length > 0 && until.every((name) => known.has(name))
  return toasts.some(({ until }) => over(until)) ? toasts.filter(({ until }) => !over(until)) : toasts
}
