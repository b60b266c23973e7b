//! A part that is wider or taller than its place can be reached and moved by keyboard, but is no stop where it fits.

export function scrolls(node: HTMLElement): () => void {
  const look = () => {
    if (node.scrollWidth > node.clientWidth + 1 || node.scrollHeight > node.clientHeight + 1) node.tabIndex = 0
    else node.removeAttribute('tabindex')
  }
  const watch = new ResizeObserver(look)
  watch.observe(node)
  if (node.firstElementChild) watch.observe(node.firstElementChild)
  look()
  return () => watch.disconnect()
}
