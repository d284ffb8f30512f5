"""The report of one run or of many: tables, figures, a video and one HTML page (`build.build`)."""
