"""The dissertation's figures and systems, each computed by one experiment behind one command.

    catalogue ──► Experiment.run(Settings) ──► Outcome ──► pages: CSV, PNG, Markdown, index
                        │ finished cells
                        ▼
                      parts

A new experiment is one module here that offers `EXPERIMENT`, and its name in `catalogue.NAMES`.
"""

from experiments.reproduce.command_line import command as command
