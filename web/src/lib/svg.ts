//! Charts as SVG text. Everything that comes from the lake goes through `escape`.
import { token } from './colour'

export const escape = (text: string) => text.replace(/[&<>"']/g, (c) => `&#${c.charCodeAt(0)};`)

const FONT = 'font-family="\'IBM Plex Sans\',\'Helvetica Neue\',Arial,sans-serif" font-size="12"'

/** A whole picture on the page's paper. */
export const picture = (width: number, height: number, body: string) =>
  `<svg xmlns="http://www.w3.org/2000/svg" width="${width}" height="${height}" viewBox="0 0 ${width} ${height}" ${FONT}><rect width="100%" height="100%" fill="${token('--paper')}"/>${body}</svg>`

export const label = (x: number, y: number, text: string, anchor = 'start') =>
  `<text x="${x}" y="${y}" text-anchor="${anchor}" fill="${token('--ink')}">${escape(text)}</text>`

/** A name with at most so many letters. */
export const shortened = (text: string, letters: number) =>
  text.length > letters ? `${text.slice(0, letters - 1)}…` : text
