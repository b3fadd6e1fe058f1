/** Browser events that end driving, even while an input is held. */
import type { StopReason } from './drive'
import { type Control, isField } from './keys'

type Where = 'window' | 'document'

interface Sign {
  where: Where
  event: string
  /** The reason why it ends driving; null if this event does not. */
  reason: (event: Event) => StopReason | null
  /** Whether the listener captures, because the event does not bubble or could be stopped. */
  down?: true
}

const always = (reason: StopReason) => () => reason

export const SIGNS: readonly Sign[] = [
  { where: 'window', event: 'blur', reason: always('window_left') },
  { where: 'window', event: 'pagehide', reason: always('page_hidden') },
  { where: 'window', event: 'offline', reason: always('link_closed') },
  { where: 'window', event: 'pointercancel', reason: always('pointer_cancelled'), down: true },
  { where: 'window', event: 'touchstart', reason: (event) => (fingers(event) > 1 ? 'several_fingers' : null), down: true },
  { where: 'window', event: 'beforetoggle', reason: (event) => (opens(event) ? 'dialog_opened' : null), down: true },
  // While the list of a select is open it gets the keyup events; the page gets neither these nor a blur.
  { where: 'window', event: 'pointerdown', reason: (event) => (isOnField(event) ? 'field_entered' : null), down: true },
  { where: 'window', event: 'focusin', reason: (event) => (isOnField(event) ? 'field_entered' : null), down: true },
  // During a drag the system takes the keys.
  { where: 'window', event: 'dragstart', reason: always('drag_began'), down: true },
  { where: 'window', event: 'beforeprint', reason: always('page_printed') },
  // On some systems a long touch of the joystick opens a menu; the joystick prevents that.
  { where: 'window', event: 'contextmenu', reason: (event) => (event.defaultPrevented ? null : 'menu_opened') },
  { where: 'document', event: 'visibilitychange', reason: (event) => (isHidden(event) ? 'page_hidden' : null) },
  { where: 'document', event: 'freeze', reason: always('page_frozen') },
  { where: 'document', event: 'fullscreenchange', reason: always('view_changed') },
  { where: 'document', event: 'pointerlockchange', reason: always('capture_lost') },
]

function opens(event: Event): boolean {
  return (event as ToggleEvent).newState === 'open'
}

function isOnField(event: Event): boolean {
  return isField(event.target as Partial<Control> as Control | null)
}

function isHidden(event: Event): boolean {
  return (event.target as Document | null)?.hidden === true
}

function fingers(event: Event): number {
  return (event as TouchEvent).touches?.length ?? 0
}

/** Calls `stop` at each of these events until the returned function is called. */
export function watchDeadman(
  places: Record<Where, EventTarget>,
  stop: (reason: StopReason) => void,
): () => void {
  const ends = SIGNS.map(({ where, event: name, reason, down = false }) => {
    const listener = (event: Event) => {
      const why = reason(event)
      if (why !== null) stop(why)
    }
    places[where].addEventListener(name, listener, { capture: down, passive: true })
    return () => places[where].removeEventListener(name, listener, { capture: down })
  })
  return () => ends.forEach((end) => end())
}
