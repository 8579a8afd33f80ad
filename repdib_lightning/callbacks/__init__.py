"""What watches a run: pictures, codebook use, exact resume, status."""
