//! The path below which the server's pages stand: a proxy may serve them below one of its own, such as `/lake`. The
//! document has it, because its addresses are relative.

// Node has no document, which checks of the pages' parts run in.
const icon = typeof document === 'undefined' ? null : document.querySelector<HTMLLinkElement>('link[rel=icon]')

// Its address stays when that of the document changes.
if (icon) icon.setAttribute('href', icon.href)

/** The path without a slash at its end: empty, or as `/lake`. */
export const BASE = icon ? new URL('.', icon.href).pathname.slice(0, -1) : ''

/** The address of a page or an answer of this server, by its path from the root of the pages. */
export const siteHref = (path: string) => BASE + path
