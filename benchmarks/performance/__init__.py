"""What `run_all.py` and the benchmarks of docs/performance*.md share: measuring, tables, figures, goals, pages."""
