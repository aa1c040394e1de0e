"""What an identified robot becomes for other programs and for people: text, no file is written."""
