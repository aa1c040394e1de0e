"""What did wheels, commands and poses do over the same steps, and how late are the poses?"""
