//! A part that is wider or taller than its place can be reached and moved by keyboard, but is no stop where it fits. Its
//! edges fade where more of it is beyond them.

export function scrolls(node: HTMLElement): () => void {
  const look = () => {
    if (node.scrollWidth > node.clientWidth + 1 || node.scrollHeight > node.clientHeight + 1) node.tabIndex = 0
    else node.removeAttribute('tabindex')
    node.toggleAttribute('data-more-left', node.scrollLeft > 1)
    node.toggleAttribute('data-more-right', node.scrollLeft + node.clientWidth < node.scrollWidth - 1)
  }
  const watch = new ResizeObserver(look)
  watch.observe(node)
  if (node.firstElementChild) watch.observe(node.firstElementChild)
  node.addEventListener('scroll', look, { passive: true })
  look()
  return () => {
    watch.disconnect()
    node.removeEventListener('scroll', look)
  }
}
