/** Notifications of the browser while the page is hidden. Permission is requested on a click only. */
import { leading, summary } from '../api/alerts'
import { recall, remember } from './storage'
import type { Alert } from '../api/types'

const KEY = 'notify'

/** The used part of the browser. */
export interface Place {
  isSecureContext: boolean
  Notification?: typeof Notification
}

/** Why this browser cannot show notifications, or null. */
export function whyNot(place: Place = globalThis): string | null {
  if (!place.isSecureContext) return 'Browsers show notifications only for pages over https.'
  if (place.Notification === undefined) return 'This browser shows no notifications.'
  if (place.Notification.permission === 'denied') {
    return 'Notifications of this page are blocked in the browser’s settings.'
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

/** Shows alerts as one notification of the browser, if notifications are on and the page is hidden.
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
    // Some phones allow this for installed pages only; then only the page itself shows the alerts.
    return false
  }
}
