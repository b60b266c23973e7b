//! Where the reader is. All of a view's state is in the address, so that every view is a link.
import { changeSearch, parseSearch, type SearchChanges } from './search'

const read = () => ({ path: location.pathname, search: location.search })

let here = $state(read())

/** Decodes a part of a path; undefined if it is malformed, as `%zz` is. */
export function decodePart(part: string): string | undefined {
  try {
    return decodeURIComponent(part)
  } catch {
    return undefined
  }
}

/** The current address, reactive. */
export const place = {
  /** As it stands in the address, with its percent signs. */
  get path(): string {
    return here.path
  },
  get search(): string {
    return here.search
  },
  get params(): URLSearchParams {
    return parseSearch(here.search)
  },
}

/** Goes to an address of this site. */
export function go(href: string, replace = false): void {
  if (href === location.pathname + location.search) return
  if (replace) history.replaceState(null, '', href)
  else history.pushState(null, '', href)
  here = read()
}

/** The address with some parameters changed; null or '' removes one, a list repeats it. */
export function withParams(changes: SearchChanges, path = location.pathname): string {
  return changeSearch(path, path === location.pathname ? here.search : '', changes)
}

/** Changes parameters in place; `push` makes it a step that Back undoes. */
export function setParams(changes: SearchChanges, push = false): void {
  go(withParams(changes), !push)
}

/** The address of a surface, of one of its pairs, of a run. */
export const surfaceHref = (id: string) => `/surfaces/${encodeURIComponent(id)}`
export const pairHref = (id: string, pair: number) => `${surfaceHref(id)}/pairs/${pair}`
export const runHref = (id: string) => `/runs/${encodeURIComponent(id)}`

/** Plain clicks on this site's links stay in the page. */
export function follow(): void {
  addEventListener('popstate', () => {
    here = read()
  })
  addEventListener('click', (event) => {
    if (
      event.defaultPrevented ||
      event.button !== 0 ||
      event.metaKey ||
      event.ctrlKey ||
      event.shiftKey ||
      event.altKey
    )
      return
    const link = (event.target as Element | null)?.closest?.('a')
    if (!link || link.target || link.hasAttribute('download') || link.origin !== location.origin) return
    if (/^\/(api|health|metrics)/.test(link.pathname)) return
    event.preventDefault()
    // A place within the page; its address stays, because that names the view.
    if (link.hash && link.pathname === location.pathname) {
      document.getElementById(link.hash.slice(1))?.focus()
      return
    }
    go(link.pathname + link.search)
    scrollTo(0, 0)
  })
}
