/** Addresses of the portal's pages. */

export type Route =
  | { page: 'login' }
  | { page: 'fleet' }
  | { page: 'alerts' }
  | { page: 'cockpit'; robot: string }
  | { page: 'unknown' }

export function parse(path: string): Route {
  const parts = path.split('/').filter(Boolean)
  if (parts.length === 0 || (parts.length === 1 && parts[0] === 'fleet')) return { page: 'fleet' }
  if (parts.length === 1 && parts[0] === 'login') return { page: 'login' }
  if (parts.length === 1 && parts[0] === 'alerts') return { page: 'alerts' }
  if (parts.length === 2 && parts[0] === 'cockpit') {
    const robot = decoded(parts[1]!)
    if (robot !== null) return { page: 'cockpit', robot }
  }
  return { page: 'unknown' }
}

function decoded(text: string): string | null {
  try {
    return decodeURIComponent(text)
  } catch {
    return null
  }
}

export const ALERTS = '/alerts'

export function cockpitPath(robot: string): string {
  return `/cockpit/${encodeURIComponent(robot)}`
}

/** Where to go after logging in: only to a page of the portal itself. */
export function afterLogin(search: string): string {
  const next = new URLSearchParams(search).get('next') ?? ''
  const route = parse(next)
  if (route.page === 'alerts') return ALERTS
  return route.page === 'cockpit' ? cockpitPath(route.robot) : '/fleet'
}

/** The one-time code of a login link, e.g. `#code=XYZ`, or null. */
export function loginCode(hash: string): string | null {
  return new URLSearchParams(hash.replace(/^#/, '')).get('code') || null
}
