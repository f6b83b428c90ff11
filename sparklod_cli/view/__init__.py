"""The viewer: splat files, and a page that shows them in Spark, served over HTTP or written as a static site."""
