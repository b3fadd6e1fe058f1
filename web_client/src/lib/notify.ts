/** The browser's own notifications, for who is not looking at the page. Asked for by a click, never by itself. */
import { type Alert, leading, summary } from './alerts'
import { recall, remember } from './storage'

const KEY = 'notify'

/** What is used of the browser. */
export interface Place {
  isSecureContext: boolean
  Notification?: typeof Notification
}

/** Why this browser can't notify, or null. */
export function whyNot(place: Place = globalThis): string | null {
  if (!place.isSecureContext) return 'A browser shows notifications of pages over https only.'
  if (place.Notification === undefined) return 'This browser shows no notifications.'
  if (place.Notification.permission === 'denied') {
    return 'This browser was told not to show notifications of this page. Its settings can change that.'
  }
  return null
}

export function isOn(place: Place = globalThis): boolean {
  return place.Notification?.permission === 'granted' && recall(KEY, { on: false }).on
}

/** Turns notifications on or off on this device; the first time the browser asks the user. Returns whether they are on. */
export async function turn(on: boolean, place: Place = globalThis): Promise<boolean> {
  if (on && whyNot(place) === null && place.Notification?.permission !== 'granted') {
    await place.Notification?.requestPermission()
  }
  const granted = on && place.Notification?.permission === 'granted'
  remember(KEY, { on: granted })
  return granted
}

/** Shows alerts outside of the page, all of them as one, where that is wanted and the page is not in front.
 *
 * @param alerts the oldest first
 */
export function notify(alerts: readonly Alert[], place: Place = globalThis, isInFront = () => document.hasFocus()): boolean {
  const Shown = place.Notification
  if (!isOn(place) || Shown === undefined || isInFront()) return false
  try {
    const { id, kind } = leading(alerts)
    new Shown(summary(alerts), { tag: id, body: kind })
    return true
  } catch {
    // Some phones allow this to installed pages only; the toast in the page has to do.
    return false
  }
}
